"""Robots that move otherwise, worked out by hand; ``test_forms`` has the oracle compare them.

One more dynamics is added to a copy of the package by ``docs/extending.md``.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from mbn_marl import BatchEngine, Field
from mbn_marl.config import make_config
from mbn_marl.engine.mdp import dynamics
from mbn_marl.engine.state import make_episode
from mbn_marl.errors import ConfigError
from mbn_marl.jit import elementary
from mbn_marl.optimum import optimal_return
from mbn_marl.planning.problem import make_problem
from tests.support.configurations import EVERYTHING, SIGHTS, entries

pytestmark = pytest.mark.slow

SQUARE = Field(
    vertices=[(0.0, 0.0), (100.0, 0.0), (100.0, 100.0), (0.0, 100.0)],
    rois=[(90.0, 90.0)],
    starts=[(20.0, 50.0), (50.0, 20.0)],
)
MIXED = ("point_mass", "bicycle")
FORWARD, LEFT, STILL = (1.0, 0.0), (0.0, 1.0), (0.0, 0.0)


def driven(*actions: Any, **settings: Any) -> BatchEngine:
    """Two equal worlds of the square in float64, after steps with an action for all or for each."""
    settings = {**EVERYTHING, "dynamics": ("point_mass", "holonomic"), **settings}
    engine = BatchEngine(SQUARE, 2, threads=1, autoreset=False, **settings)
    engine.reset()
    for action in actions:
        engine.step(np.broadcast_to(np.asarray(action), (2, 2, 2)))
    return engine


def first(engine: BatchEngine) -> tuple[list[float], list[float], float]:
    """Position, velocity and heading of the first robot."""
    now = engine.snapshot(1)
    return now.positions[0].tolist(), now.velocities[0].tolist(), float(now.headings[0])


def problems_of(**settings: Any) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        BatchEngine(SQUARE, 2, **settings)
    return list(caught.value.problems)


def test_names_and_numbers_are_checked_all_at_once() -> None:
    (problem,) = problems_of(dynamics="hovercraft")
    assert problem.startswith("dynamics: ")
    found = problems_of(dynamics=("unicycle", "sledge"), f_max=(1.0, -1.0), steer_max=1.6, mass=[])
    assert [problem.split(":")[0] for problem in found] == [
        "dynamics.1",
        "f_max.1",
        "mass",
        "steer_max",
    ]
    found = problems_of(dynamics=("unicycle",) * 3, v_clip=(1.0,))
    assert [problem.split(":")[0] for problem in found] == ["dynamics", "v_clip"]


def test_those_without_a_heading_have_no_entries_for_it() -> None:
    engine = driven(STILL, max_steps=1)
    assert not any("heading" in part for part in engine.save_state())
    for name in ("point_mass", "holonomic"):
        assert make_episode(2, 2, make_config({"dynamics": name})).heading.shape == (0, 2)
    assert engine.state().shape == (2, 11)
    assert np.isnan(engine.snapshot().headings).all()
    engine.reset_worlds(np.array([True, False]))
    engine.step(np.zeros((2, 2, 2)), active=np.array([True, False]))  # keeps the other as it is


def test_a_heading_is_reset_kept_and_final() -> None:
    engine = BatchEngine(SQUARE, 2, **{**EVERYTHING, "dynamics": "unicycle", "max_steps": 1})
    engine.reset()
    engine.step(np.full((2, 2, 2), (0.0, 1.0)))  # ends, and restarts
    assert engine.final_state()[:, 8:10].tolist() == [[0.3, 0.3]] * 2
    assert not engine.state()[:, 8:10].any()
    saved = engine.save_state()
    assert saved["now.heading"].shape == saved["final.cos"].shape == (2, 2)


def test_numbers_by_hand() -> None:
    assert dynamics.force(-3.0, 0.5, 1.0) == -0.5
    assert dynamics.next_velocity(1.0, -0.5, 2.0, 0.25, 5.0) == 1.0
    assert dynamics.next_velocity(4.5, 0.5, 1.0, 0.25, 5.0) == 5.0
    assert dynamics.next_position(10.0, -2.0, 0.5) == 9.0
    assert dynamics.objective(3.0, -4.0) == 5.0
    assert dynamics.held_velocity(0.5, 2.0, 0.25, 5.0, 1.0) == 0.25
    assert dynamics.held_velocity(0.5, 2.0, 0.75, 5.0, 1.0) == 0.5


@pytest.mark.parametrize("real", [np.float32, np.float64])
def test_headings_stay_in_half_a_turn_either_way(real: Any) -> None:
    pi = real(math.pi)
    for heading, turn, expected in [(3.0, 0.5, 3.5 - 2 * math.pi), (-3.0, -0.5, 2 * math.pi - 3.5)]:
        assert dynamics.turned(real(heading), real(turn), pi) == pytest.approx(expected, abs=1e-6)
    assert dynamics.turned(pi, real(0.0), pi) == dynamics.turned(-pi, real(0.0), pi) == -pi
    below = np.nextafter(pi, real(0.0))
    assert dynamics.turned(below, real(0.0), pi) in (below, -pi)  # apart by a rounding of 2 pi
    assert dynamics.turned(real(1.0), real(20.0), pi) == pytest.approx(21 - 6 * math.pi, abs=1e-5)
    for turn in (1e30, -1e30, math.inf):
        assert -pi <= dynamics.turned(real(0.0), real(turn), pi) < pi


def test_sine_cosine_and_tangent() -> None:
    angles = np.linspace(-math.pi, math.pi, 4001)
    for angle in angles.tolist():
        assert elementary.sine(angle) == pytest.approx(math.sin(angle), abs=4e-16)
        assert elementary.cosine(angle) == pytest.approx(math.cos(angle), abs=4e-16)
        assert -1.0 <= elementary.sine(angle) <= 1.0
    for angle in angles[abs(angles) <= 1.5].tolist():
        assert elementary.tangent(angle) == pytest.approx(math.tan(angle), rel=1e-14, abs=1e-15)
    assert (elementary.sine(0.0), elementary.cosine(0.0), elementary.tangent(0.0)) == (0, 1, 0)


def test_holonomic_takes_the_velocity_that_it_is_told() -> None:
    engine = driven((0.05, -1.0), (0.05, -1.0), dynamics="holonomic", mass=2.0)
    # 0.25 of the force of 0.5 is a change of 0.25 at most; the wanted velocity is (0.25, -5).
    assert first(engine)[:2] == ([20.5, 49.25], [0.25, -0.5])
    assert engine.metrics()["impulse"][0, 0] == math.hypot(0.5, 1.0)  # 2 (0.25 + 0), 2 (-0.5)
    blown = driven(STILL, STILL, dynamics="holonomic", wind=(0.125, 0.0))
    assert first(blown)[1] == [0.125, 0.0]  # it brakes what the wind gave it before


def test_a_unicycle_turns_then_goes_where_it_faces() -> None:
    engine = driven(FORWARD, (1.0, 1.0), (-1.0, 1.0), dynamics="unicycle", turn_max=math.pi / 6)
    c, s = math.cos(math.pi / 6), 0.5
    place, velocity, heading = first(engine)
    assert heading == pytest.approx(math.pi / 3, abs=1e-15)
    assert velocity == pytest.approx([0.5 * s, 0.5 * c], abs=1e-14)
    assert place == pytest.approx([20 + 0.5 + c + 0.5 * s, 50 + s + 0.5 * c], abs=1e-13)
    impulse = (0.5 + 0.5 * c - 0.5 * s, 0.5 * s - 0.5 * c)
    assert engine.metrics()["impulse"][0, 0] == pytest.approx(math.hypot(*impulse), abs=1e-13)


def test_speeds_are_signed_limited_and_blown_along_the_heading() -> None:
    back = driven(*[(-1.0, 0.0)] * 3, dynamics="unicycle", v_clip=1.25)
    assert first(back) == ([20 - 0.5 - 1.0 - 1.25, 50.0], [-1.25, 0.0], 0.0)
    blown = driven(LEFT, dynamics="unicycle", turn_max=math.pi / 2, wind=(0.25, 90.0))
    assert first(blown)[1] == pytest.approx([0.0, 0.25], abs=1e-15)
    across = driven(STILL, dynamics="unicycle", wind=(0.25, 90.0))
    assert first(across)[1] == pytest.approx([0.0, 0.0], abs=1e-15)


def test_a_bicycle_turns_by_its_speed() -> None:
    still = driven(LEFT, LEFT, dynamics="bicycle")
    assert first(still) == ([20.0, 50.0], [0.0, 0.0], 0.0)
    engine = driven((1.0, 1.0), (1.0, -1.0), dynamics="bicycle", wheelbase=2.0, steer_max=0.75)
    one = 0.5 / 2 * math.tan(0.75)
    two = one - 1.0 / 2 * math.tan(0.75)
    place, velocity, heading = first(engine)
    assert heading == pytest.approx(two, abs=1e-14)
    assert velocity == pytest.approx([math.cos(two), math.sin(two)], abs=1e-14)
    moved = [20 + 0.5 * math.cos(one) + math.cos(two), 50 + 0.5 * math.sin(one) + math.sin(two)]
    assert place == pytest.approx(moved, abs=1e-13)
    backwards = driven((-1.0, 1.0), dynamics="bicycle", wheelbase=2.0, steer_max=0.75)
    assert first(backwards)[2] == pytest.approx(-one, abs=1e-14)


@pytest.mark.parametrize("name", ["unicycle", "bicycle"])
def test_a_wall_leaves_the_heading_as_it_was(name: Any) -> None:
    engine = driven((-1.0, 0.0), (-1.0, 0.5), dynamics=name, f_max=20.0, v_clip=20.0)
    place, velocity, heading = first(engine)
    assert (place, velocity, heading) == ([0.0, 50.0], [0.0, 0.0], 0.0)
    assert engine.metrics()["wall_hits"][0, 0] == 1


def test_each_robot_has_its_own_dynamics_and_limits() -> None:
    limits = {"mass": (1.0, 2.0), "f_max": (0.5, 4.0), "v_clip": (5.0, 1.5)}
    engine = driven((1.0, 1.0), dynamics=MIXED, **limits)
    now = engine.snapshot()
    turn = 1.5 / 4 * math.tan(0.5)
    assert now.velocities[0].tolist() == [0.5, 0.5]
    assert now.velocities[1] == pytest.approx([1.5 * math.cos(turn), 1.5 * math.sin(turn)])
    assert np.isnan(now.headings[0]) and now.headings[1] == pytest.approx(turn)
    assert engine.state()[0, 8:].tolist() == [0.0, now.headings[1], 0.0, 0.0, 0.0]
    assert engine.state_high[4:].tolist() == [5.0] * 4 + [math.pi] * 2 + [1.0] * 3
    alone = driven((1.0, 1.0), dynamics="bicycle", mass=2.0, f_max=4.0, v_clip=1.5)
    assert alone.snapshot().positions[1].tolist() == now.positions[1].tolist()


@pytest.mark.parametrize("observation", SIGHTS)
def test_every_observation_shows_the_headings(observation: str) -> None:
    settings = {**SIGHTS[observation], "one_hot": True, "dynamics": ("point_mass", "unicycle")}
    engine = driven((1.0, 1.0), **settings)
    mine, theirs = entries(engine, 0), entries(engine, 1)
    turned = [pytest.approx(math.cos(0.3)), pytest.approx(math.sin(0.3))]
    names = ["own_cos", "own_sin", "other_1_cos", "other_1_sin"]
    assert {name for name in mine if name.endswith(("cos", "sin"))} == {*names}
    assert [mine[name] for name in names] == [0.0, 0.0, *turned]
    assert [theirs[name] for name in names] == [*turned, 0.0, 0.0]
    assert [mine["is_robot_0"], theirs["is_robot_0"]] == [1.0, 0.0]
    if observation in ("local", "lidar_local"):
        far = driven((1.0, 1.0), sensing_radius=30, **settings)
        assert [entries(far, 0)[name] for name in names] == [0.0] * 4


def test_the_scale_of_velocities_is_the_highest_limit() -> None:
    settings: dict[str, Any] = {"observation": "lidar", "sensing_radius": 1000.0}
    engine = driven(FORWARD, v_clip=(5.0, 10.0), f_max=2.0, **settings)
    assert entries(engine, 0)["own_vx"] == pytest.approx(0.2)
    assert entries(engine, 0)["time_to_wall"] == pytest.approx(
        78 / 2 / 100
    )  # of the 100 steps at 10 units


def test_a_robot_with_a_heading_brakes_along_it() -> None:
    # Velocities 0.5, 1, ... 4: 18 units, and 14 more until it stands, 3.5 + 3 + ... + 0.5.
    for room, inside in ((32.0, 1.0), (31.9, 0.0)):
        field = Field(vertices=SQUARE.vertices, rois=SQUARE.rois, starts=[(50.0, 100.0 - room)])
        settings = {"observation": "lidar", "turn_max": math.pi / 2, "dynamics": "unicycle"}
        engine = BatchEngine(field, 2, threads=1, **{**EVERYTHING, **settings})
        engine.reset()
        for turn in (1.0, *[0.0] * 7):
            engine.step(np.full((2, 1, 2), (1.0, turn)))
        assert entries(engine, 0)["brake_inside"] == inside
    pushed = driven(FORWARD, dynamics="unicycle", observation="lidar", wind=(0.5, 0.0))
    assert entries(pushed, 0)["brake_inside"] == 0.0  # no force is left against the wind
    across = driven(FORWARD, dynamics="unicycle", observation="lidar", wind=(0.5, 90.0))
    assert entries(across, 0)["brake_inside"] == 1.0


def test_turning_on_the_spot_is_a_new_joint_state() -> None:
    engine = driven(LEFT, dynamics="unicycle", reward="formal")
    assert engine.team_rewards.tolist() == [0.0, 0.0]  # -r_s inside, +r_s for a new state
    engine.step(np.zeros((2, 2, 2)))
    assert engine.team_rewards.tolist() == [-110.0, -110.0]  # known


def test_no_bound_is_claimed_for_others_than_point_masses() -> None:
    field = Field(**{**SQUARE.to_dict(), "optimal_makespan": 20, "starts": SQUARE.starts})
    assert optimal_return(field) is not None
    for name in ("holonomic", "unicycle", "bicycle", MIXED):
        config = make_config({"dynamics": name})
        assert optimal_return(field, config) is None
        with pytest.raises(ConfigError, match="dynamics"):
            make_problem(field, config)
    problem = make_problem(field, make_config({"f_max": (1.0, 2.0), "v_clip": (3.0, 4.0)}))
    assert problem.forces.tolist() == [[1.0, 1.0], [2.0, 2.0]]
    assert [drive.top for drive in problem.drives] == [3.0, 4.0]
