"""The deployment loop: in the plane it is the environment, elsewhere it judges what is measured."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from baselines.evaluation.rollout import record_episode
from baselines.policies.classical import make_classical
from baselines.policies.load import load_trained, open_run
from mbn_marl.config import Uniform
from mbn_marl.engine import BatchEngine, TrackedWorld
from mbn_marl.episode import Episode
from mbn_marl.errors import ActionError, ConfigError, StepError
from mbn_marl.field import Field, load_field
from mbn_marl.sim3d import Mission, PlaneSimulator, Scale, deploy
from tests.support.configurations import EVERYTHING
from tests.support.missions import SMALL, Wander
from tests.support.worlds import DISTURBANCES

pytestmark = pytest.mark.slow
TWO = EVERYTHING | {"dynamics": ("point_mass", "holonomic")}


def assert_same_episode(policy: Any, field: Field, settings: Mapping[str, Any]) -> Episode:
    ours = deploy(policy(), field, settings, PlaneSimulator(), seed=3).episode
    theirs = record_episode(policy(), field, settings, seed=3)
    for name in ("actions", "positions", "headings", "visits", "failed", "terms", "team_rewards"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name), err_msg=name)
    assert ours.outcome == theirs.outcome
    return ours


@pytest.mark.parametrize(
    ("policy", "field", "settings"),
    [
        ("greedy", "field_01", {"wind": (0.3, 30.0)}),
        ("wander", "field_04", {"max_steps": 60, "reward": "formal", "random_starts": True}),
        ("zoo", "field_03", {"wind": (0.1, 30.0)}),
    ],
)
def test_plane_gives_the_environments_episode(policy, field, settings):
    place, run = load_field(field), open_run("zoo:field_03")
    if policy == "zoo":
        settings = {**run.config["environment"], **settings}
    makers = {
        "greedy": lambda: make_classical("greedy", place, {}),
        "wander": Wander,
        "zoo": lambda: load_trained(run),
    }
    assert_same_episode(makers[policy], place, settings)


@pytest.mark.parametrize("kind", ["brake", "coast", "vanish"])
def test_disturbed_robots_that_turn_and_fail_are_on_the_plane_as_in_the_engine(kind):
    settings = EVERYTHING | DISTURBANCES | {"dynamics": ("unicycle", "bicycle")}
    settings |= {"f_max": 2.0, "max_steps": 60, "mass": Uniform(1.0, 1.2)}
    settings["failures"] = {"at": {1: 35}, "kind": kind}
    ours = assert_same_episode(Wander, SMALL, settings)
    assert np.ptp(ours.headings) > 1.0 and (ours.terms[..., 2] < 0).any()
    assert ours.failed.tolist() == [0, 35]


class Windy(PlaneSimulator):
    """Notes who fails; has a wind, which nothing feels; its vehicles cannot vanish."""

    has_wind, failures = True, ("brake", "coast")

    def reset(self, mission: Mission) -> None:
        super().reset(mission)
        self.steps, self.notes = 0, list[tuple[int, int, str]]()

    def fail(self, robot: int, kind: str) -> None:
        self.notes.append((self.steps, robot, kind))

    def step(self) -> None:
        super().step()
        self.steps += 1


def test_simulator_learns_once_who_fails():
    failing = TWO | {"failures": {"at": {1: 3, 0: 5}, "kind": "coast"}, "max_steps": 7}
    simulator = Windy()
    done = deploy(Wander(), SMALL, failing, simulator)
    assert simulator.notes == [(2, 1, "coast"), (4, 0, "coast")]
    assert done.episode.failed.tolist() == [5, 3]
    failing["failures"] = {"kind": "vanish"}
    with pytest.raises(ConfigError, match=r"failures\.kind: "):
        deploy(Wander(), SMALL, failing, simulator)


def test_wind_of_a_simulator_is_in_the_episode():
    settings = TWO | {"wind": (0.25, 90.0), "gust": 0.1, "max_steps": 5}
    own, plane = (
        deploy(Wander(), SMALL, settings, kind()).episode for kind in (Windy, PlaneSimulator)
    )
    np.testing.assert_allclose(own.winds, plane.winds, rtol=1e-12)
    assert own.snapshot(5).wind == pytest.approx(plane.snapshot(5).wind)
    assert not np.array_equal(own.positions, plane.positions)


def test_deployed_episode_has_the_numbers_that_the_engine_draws():
    settings = TWO | {"mass": Uniform(1.0, 2.0), "max_steps": 5}
    engine = BatchEngine(SMALL, 1, seed=3, **settings)
    engine.reset()
    shown = deploy(Wander(), SMALL, settings, Windy(), seed=3).episode
    assert shown.config == engine.config
    assert shown.drawn == {name: numbers[0] for name, numbers in engine.drawn().items()}
    windy = deploy(Wander(), SMALL, settings | {"wind": (Uniform(0.1, 0.3), 90.0)}, Windy(), seed=3)
    assert shown.drawn.keys() == windy.episode.drawn.keys() == windy.episode.config.drawn.keys()
    assert windy.tracking_error > 0.0


def test_a_mission_that_an_error_ends_is_abandoned():
    class Lost(PlaneSimulator):
        abandoned = 0

        def step(self) -> None:
            raise RuntimeError("lost")

        def abandon(self) -> None:
            self.abandoned += 1

    simulator = Lost()
    with pytest.raises(RuntimeError, match="lost"):
        deploy(Wander(), SMALL, TWO, simulator)
    assert simulator.abandoned == 1


def test_drawn_limits_do_not_change_the_scale_of_observations():
    settings = {"observation": "entities", "v_clip": Uniform(1.0, 5.0), "max_steps": 20}
    assert_same_episode(Wander, SMALL, settings)


@pytest.fixture
def tracked():
    """Two robots at (120, 120) and (380, 120), commanded to stay."""
    engine = BatchEngine(SMALL, 1, autoreset=False, threads=1)
    world = TrackedWorld(engine)
    engine.reset()
    world.command(np.zeros((2, 2)))
    return engine, world


def test_positions_are_judged_where_they_were_measured(tracked):
    engine, world = tracked
    world.measure([(141.0, 150.0), (120.0, 99.0)], [(9.0, -9.0), (0.0, 0.0)])
    now = engine.snapshot()
    assert now.visited.tolist() == [True, False, False]
    np.testing.assert_array_equal(now.velocities[0], (5.0, -5.0))  # as far as the MDP knows speeds
    np.testing.assert_array_equal(now.positions[1], (120.0, 99.0))  # it is outside, and pays
    assert engine.team_rewards[0] == 10_000.0 - 10_000.0 - 2 * 10.0
    assert engine.metrics()["wall_hits"][0].tolist() == [0, 1]


def test_command_out_of_the_field_is_to_stay(tracked):
    _, world = tracked
    world.measure([(120.0, 102.0), (380.0, 120.0)], [(0.0, -4.0), (0.0, 0.0)])
    command = world.command(np.ones((2, 2)) * (0.0, 1.0))
    assert command.allowed.tolist() == [False, True]
    np.testing.assert_array_equal(command.velocities, [(0.0, 0.0), (0.0, 0.5)])


def test_vehicles_own_limit_bounds_its_commands(tracked):
    engine, world = tracked[0], TrackedWorld(tracked[0], speed_limit=2.0)
    world.command(np.zeros((2, 2)))
    world.measure(SMALL.starts + 5.0, [(1.9, 0.0), (0.0, 4.0)])
    np.testing.assert_array_equal(world.command(np.ones((2, 2))).velocities, [(2, 0.5), (0.5, 2)])
    assert engine.config.v_clip == 5.0  # the observation's scale is the policy's


def test_measured_collision_ends_the_episode(tracked):
    engine, world = tracked
    world.measure([(150.0, 120.0), (159.9, 120.0)], np.zeros((2, 2)))
    assert engine.snapshot().collision
    with pytest.raises(StepError, match="has ended"):
        world.command(np.zeros((2, 2)))


def test_wrong_measurements_and_numbers_are_errors(tracked):
    engine, world = tracked
    with pytest.raises(StepError, match=r"allowed: measure\(\) first"):
        world.command(np.zeros((2, 2)))
    for positions in ([(1.0, 2.0)], np.full((2, 2), np.nan)):
        with pytest.raises(ActionError):
            world.measure(positions, np.zeros((2, 2)))
    world.measure(SMALL.starts, np.zeros((2, 2)))
    with pytest.raises(StepError, match=r"allowed: command\(\) first"):
        world.measure(SMALL.starts, np.zeros((2, 2)))
    for actions in ([[1.0, 0.0], [1.0]], np.zeros((3, 2))):
        with pytest.raises(ActionError, match="actions: "):
            world.command(actions)
    for limit in (np.nan, "3"):
        with pytest.raises(ConfigError, match="speed_limit: "):
            TrackedWorld(engine, limit)
    with pytest.raises(ConfigError, match="autoreset same_step; allowed: one world"):
        TrackedWorld(BatchEngine(SMALL, 1))
    with pytest.raises(ConfigError, match=r"metres: 0\.0"):
        Scale(metres=0.0)
    assert (Scale(0.2, 0.5).speed, Scale(0.2, 0.5).acceleration(tau=2.0)) == (0.4, 0.4)
