"""The proved optimum of a field as a return, and the gap to it in the infos."""

import numpy as np
import pytest

from mbn_marl import centralized_env, parallel_env
from mbn_marl.adapters.infos import UNDEFINED
from mbn_marl.config import make_config
from mbn_marl.episode import play
from mbn_marl.field import Field, load_field
from mbn_marl.optimum import optimal_makespan, optimal_return
from mbn_marl.planning import plan


def test_environments_say_their_optimal_return():
    assert parallel_env("field_03").unwrapped.optimal_return == 159_490.0
    assert centralized_env("field_09").unwrapped.optimal_return == 157_510.0
    field = load_field("field_03")
    for other in ({"wind": (0.1, 0.0)}, {"gust": 0.1}, {"action_delay": 1}):
        assert optimal_return(field, make_config(other)) is None
    blind = make_config({"position_noise": 1.0, "velocity_noise": 0.1, "dropout": 0.5})
    assert optimal_return(field, blind) == 159_490.0  # what is seen changes no return
    for limit, best in ((17, 159_490.0), (16, None)):  # T* = 17
        assert optimal_return(field, make_config({"max_steps": limit})) == best


def test_a_delay_adds_its_steps_to_the_makespan():
    square = [(0, 0), (90, 0), (90, 90), (0, 90)]
    field = Field(square, [(30, 30), (60, 60)], [(50, 20), (30, 70)], name="late")
    found = plan(field)
    field = Field(square, field.rois, field.starts, optimal_makespan=found.makespan)
    late = make_config({"action_delay": 3})
    episode = play(field, late, np.concatenate([found.actions, np.zeros((3, 2, 2))]))
    assert episode.outcome == "success"
    assert len(episode.actions) == optimal_makespan(field, late) == found.makespan + 3
    assert optimal_return(field, late) is None  # robots that rest pay for known ground
    assert load_field("field_03").optimal_makespan == 17
    assert optimal_makespan(load_field("field_03"), late) is None  # two ROIs are in reach


def test_no_optimum_is_claimed_where_a_wall_might_pay():
    # 40 robots for 26 steps cost 10,400, more than the 10,000 of a push against the wall.
    starts = [(20.0 + 20.0 * k, 20.0) for k in range(40)]
    corners = [(0, 0), (1000, 0), (1000, 300), (0, 300)]
    for makespan, claimed in ((25, 110_000 - 10_000), (26, None)):
        field = Field(corners, [(500.0, 200.0)], starts, optimal_makespan=makespan)
        assert optimal_return(field) == claimed


def test_infos_report_the_gap_at_the_end():
    found = plan("field_03")
    env = parallel_env("field_03")
    env.reset(seed=0)
    gaps = []
    for actions in found.actions:
        infos = env.step(dict(zip(env.agents, actions, strict=True)))[-1]
        gaps.append({info["optimality_gap"] for info in infos.values()})
    assert gaps == [{UNDEFINED}] * 16 + [{0.0}]
    team = centralized_env("field_03")
    team.reset(seed=0)
    gaps = [team.step(np.zeros((3, 2)))[-1]["optimality_gap"] for _ in range(1000)]
    # Two ROIs lie exactly 10 units from starts; a step on known ground costs 100, a new one 10.
    total = 2 * 10_000 - 3 * (10 + 999 * 100)
    assert gaps == [*[UNDEFINED] * 999, pytest.approx(1.0 - total / 159_490)]
    unproved = centralized_env("field_03", wind=(0.1, 0.0), max_steps=1)
    infos = unproved.reset()[1], unproved.step(np.zeros((3, 2)))[-1]
    assert [info["optimality_gap"] for info in infos] == [UNDEFINED] * 2
