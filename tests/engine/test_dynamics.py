"""The seam between dynamics and the rest: the name is checked, and what is not used is not there.

A second dynamics, with a heading, is added to a copy of the package by ``docs/extending.md``.
"""

from __future__ import annotations

import numpy as np
import pytest

from mbn_marl import BatchEngine
from mbn_marl.config import make_config
from mbn_marl.engine.mdp import dynamics
from mbn_marl.engine.state import make_episode
from mbn_marl.errors import ConfigError


def test_an_unknown_dynamics_is_an_error() -> None:
    with pytest.raises(ConfigError) as caught:
        BatchEngine("field_03", 2, dynamics="hovercraft")  # type: ignore[arg-type]
    (problem,) = caught.value.problems
    assert problem.startswith("dynamics: ") and "point_mass" in problem


def test_a_point_mass_has_no_heading() -> None:
    engine = BatchEngine("field_03", 2, dynamics="point_mass", autoreset=False, max_steps=1)
    engine.reset()
    assert not any("heading" in name for name in engine.save_state())
    assert make_episode(2, 3, make_config({})).heading.shape == (0, 2)
    engine.step(np.zeros((2, 3, 2)))
    engine.reset_worlds(np.array([True, False]))
    engine.step(np.zeros((2, 3, 2)), active=np.array([True, False]))  # keeps the other world as is


def test_a_dynamics_that_turns_has_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dynamics, "WITH_HEADING", frozenset({"point_mass"}))
    engine = BatchEngine("field_03", 2, dtype="float64", autoreset=True, max_steps=1)
    engine.reset()
    backend = engine._backend
    backend.now.heading[:] = [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]
    assert engine.save_state()["now.heading"].tolist() == [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]
    engine.step(np.zeros((2, 3, 2)))  # ends, and restarts
    assert backend.final.heading.tolist() == [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]
    assert not backend.now.heading.any()


def test_numbers_by_hand() -> None:
    assert dynamics.force(-3.0, 0.5, 1.0) == -0.5
    assert dynamics.next_velocity(1.0, -0.5, 2.0, 0.25, 5.0) == 1.0
    assert dynamics.next_velocity(4.5, 0.5, 1.0, 0.25, 5.0) == 5.0
    assert dynamics.next_position(10.0, -2.0, 0.5) == 9.0
    assert dynamics.objective(3.0, -4.0) == 5.0
