"""Robots that fail, worked out by hand; ``test_forms`` has the oracle compare them."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from mbn_marl import BatchEngine, Field
from mbn_marl.config import Failures, NavigationConfig, make_config
from mbn_marl.engine.state import make_episode, make_memory
from mbn_marl.engine.tracked_world import TrackedWorld
from mbn_marl.errors import ConfigError
from mbn_marl.optimum import optimal_return
from mbn_marl.planning.problem import make_problem
from tests.support.configurations import EVERYTHING, SIGHTS, entries, seeing
from tests.support.disturbances import FAILURES, key_of, uniform

pytestmark = pytest.mark.slow

SQUARE = Field(
    vertices=[(0.0, 0.0), (100.0, 0.0), (100.0, 100.0), (0.0, 100.0)],
    rois=[(90.0, 90.0), (10.0, 90.0)],
    starts=[(20.0, 50.0), (50.0, 20.0), (80.0, 50.0)],
)
FORWARD, STILL = (1.0, 0.0), (0.0, 0.0)


def started(field: Field = SQUARE, **settings: Any) -> BatchEngine:
    """Two worlds, reset."""
    engine = BatchEngine(field, 2, threads=1, autoreset=False, **{**EVERYTHING, **settings})
    engine.reset()
    return engine


def go(engine: BatchEngine, *actions: Any) -> BatchEngine:
    """Take steps with an action for all robots, or one for each."""
    for action in actions:
        engine.step(np.broadcast_to(np.asarray(action, float), (2, engine.n_robots, 2)))
    return engine


def velocities(engine: BatchEngine) -> list[list[float]]:
    return engine.snapshot(1).velocities.tolist()


def test_all_problems_are_named_at_once() -> None:
    with pytest.raises(ConfigError) as caught:
        make_config({"failures": {"rate": 2, "at": {64: 0, "x": 1}, "kind": "stop", "mots": 1}})
    places = [problem.split(":")[0] for problem in caught.value.problems]
    assert places == [
        "failures.rate",
        "failures.at.64.[key]",
        "failures.at.64",
        "failures.at.x.[key]",
        "failures.kind",
        "failures.mots",
    ]
    with pytest.raises(ConfigError) as caught:
        failing = Failures(at={0: 21, 1: 20, 3: 2, 7: 2}, most=4)
        BatchEngine(SQUARE, 2, failures=failing, mass=(1.0,), max_steps=20)
    places = [problem.split(";")[0] for problem in caught.value.problems]
    assert places == [
        *("mass: 1 values", "failures.at: robot 3", "failures.at: robot 7"),
        *("failures.at.0: step 21", "failures.most: 4"),
    ]
    for n, most in ((3, 0), (1, None)):  # rates of no effect
        with pytest.raises(ConfigError, match=r"failures\.most"):
            BatchEngine(SQUARE, 2, n_robots=n, failures=Failures(rate=0.1, most=most))


def test_a_configuration_comes_back_from_json() -> None:
    config = make_config({"failures": {"rate": 0.1, "at": {"2": 5}, "kind": "coast"}})
    assert config.failures == Failures(rate=0.1, at={2: 5}, kind="coast")
    assert NavigationConfig(**json.loads(json.dumps(config.model_dump(mode="json")))) == config


def test_without_failures_there_are_no_entries_for_them() -> None:
    config = make_config({})
    now = make_episode(2, 3, config)
    assert now.status.shape == (0, 0, 2)
    assert make_memory(2, 3, 2, config, now).key.shape == (0,)


@pytest.mark.parametrize("kind", ["brake", "coast", "vanish"])
def test_a_failed_robot_of_each_dynamics(kind: Any) -> None:
    wind, turn = (0.125, 0.0), np.pi / 3
    failing = Failures(at={0: 3, 1: 3, 2: 3}, kind=kind)
    engine = started(failures=failing, wind=wind, f_max=0.25, turn_max=turn)
    actions = ((1.0, -1.0), (1.0, -1.0), (1.0, 0.0))
    go(engine, actions, actions)
    assert velocities(engine) == [[0.75, -0.5], [0.75, -0.5], [0.75, 0.0]]
    impulse = engine.metrics()["impulse"][1].tolist()
    go(engine, np.ones((3, 2)))  # their actions make no difference
    after = {"brake": [0.5, -0.25], "coast": [0.875, -0.5], "vanish": [0.0, 0.0]}[kind]
    assert velocities(engine) == [after, after, [after[0], 0.0]]
    headings = engine.snapshot(1).headings
    assert headings[2] == 0.0 and np.isnan(headings[:2]).all()
    go(engine, *[np.ones((3, 2))] * 4)
    after = {"brake": [0.0, 0.0], "coast": [1.375, -0.5], "vanish": [0.0, 0.0]}[kind]
    assert velocities(engine) == [after, after, [after[0], 0.0]]
    assert engine.metrics()["impulse"][1].tolist() == impulse
    path = {"brake": 0.5 + 0.25, "coast": 0.875 + 1 + 1.125 + 1.25 + 1.375, "vanish": 0.0}[kind]
    assert engine.metrics()["path_length"][1, 2] == 0.375 + 0.75 + path


def test_a_robot_with_a_heading_brakes_along_it() -> None:
    engine = started(failures=Failures(at={2: 2}), turn_max=np.pi / 2, wind=(0.1, 0.0))
    go(engine, (1.0, 1.0), (1.0, 1.0))
    assert velocities(engine)[2] == pytest.approx([0.0, 0.0], abs=1e-15)  # 0.5 - 0.5, up
    assert engine.snapshot(1).headings[2] == pytest.approx(np.pi / 2)


def test_robots_fail_in_their_step_and_by_chance_until_most_have() -> None:
    engine = started(failures=Failures(at={1: 1, 2: 3}, most=1, rate=1.0))
    flags = [go(engine, STILL).snapshot(1).failed.tolist() for _ in range(3)]
    assert flags == [[True, True, False]] * 2 + [[True] * 3]
    for most, expected in [(None, [True, True, False]), (1, [True, False, False]), (3, [True] * 3)]:
        engine = go(started(failures=Failures(rate=1.0, most=most)), STILL, STILL)
        assert engine.snapshot().failed.tolist() == expected
        engine.reset_worlds(np.array([False, True]))
        assert engine.metrics()["failed"].tolist() == [expected, [False] * 3]


def test_chance_is_the_worlds_own_stream() -> None:
    """Against Python's integers, over episodes, worlds, and robots that have failed before."""
    rate, worlds, seed = 0.2, 40, 9
    failing = {"failures": Failures(rate=rate, at={1: 2}, most=2)}
    settings = {**EVERYTHING, **failing, "max_steps": 6, "random_starts": True}
    engine = BatchEngine(SQUARE, worlds, seed=seed, threads=1, **settings)
    engine.reset()
    failed, steps, episode = np.zeros((worlds, 3), bool), np.zeros(worlds, int), [0] * worlds
    chances = 0
    for _ in range(18):
        _, _, terminated, truncated = engine.step(np.zeros((worlds, 3, 2)))
        for w in range(worlds):
            for i in range(3):
                key = key_of(seed, w, episode[w], FAILURES)
                drawn = bool(uniform(key, int(steps[w]) * 64 + i) < rate)
                drawn &= int(failed[w].sum()) < 2
                chances += drawn
                failed[w, i] |= drawn or (i == 1 and steps[w] == 1)
        assert engine.metrics(["failed"])["failed"].tolist() == failed.tolist()
        ended = terminated | truncated
        steps = np.where(ended, 0, steps + 1)
        episode = [number + int(over) for number, over in zip(episode, ended, strict=True)]
        failed[ended] = False
    assert chances > worlds


def test_what_is_on_changes_nothing_until_it_does_something() -> None:
    """The last robot has a heading, and does nothing."""
    for reward in ("released", "formal"):
        options: dict[str, Any] = {"reward": reward, "dtype": "float64"}
        plain = BatchEngine(SQUARE, 2, autoreset=False, threads=1, **options)
        plain.reset()
        dynamics = ("point_mass", "point_mass", "unicycle")
        other = started(reward=reward, failures=Failures(at={0: 99}), dynamics=dynamics)
        actions = np.random.default_rng(0).uniform(-1, 1, (30, 2, 3, 2))
        actions[:, :, 2] = 0.0
        for action in actions:
            ours, theirs = plain.step(action), other.step(action)
            for mine, found in zip(ours[1:], theirs[1:], strict=True):
                assert np.array_equal(mine, found)
            assert np.array_equal(plain.infos(), other.infos())
            seen = entries(other, 0)
            assert {name: seen[name] for name in entries(plain, 0)} == entries(plain, 0)
            if (ours[2] | ours[3]).any():
                break


def test_the_robots_that_work_share_what_the_team_gets() -> None:
    near = Field(vertices=SQUARE.vertices, rois=[(90.0, 50.0)], starts=SQUARE.starts)
    engine = started(near, failures=Failures(at={0: 1}), roi_radius=9.5)
    _, rewards, terminated, _ = engine.step(np.broadcast_to([FORWARD], (2, 3, 2)))
    assert rewards[1].tolist() == [0.0, 49_990.0, 59_990.0]
    assert engine.team_rewards.tolist() == [109_980.0] * 2
    assert terminated.all() and engine.metrics()["success"].all()
    assert engine.infos()[1, :, 6].tolist() == [1.0, 0.0, 0.0]
    # A failed robot visits all the same; nobody earns r_l for it. If none works, all share.
    for at, shares in [({2: 2}, [50_000.0, 50_000.0, 0.0]), ({0: 2, 1: 2, 2: 2}, [1e5 / 3] * 3)]:
        failing = Failures(at=at, kind="coast")
        engine = started(near, failures=failing, roi_radius=9.0, f_max=0.75)
        engine.step(np.broadcast_to([FORWARD], (2, 3, 2)))
        _, rewards, terminated, _ = engine.step(np.broadcast_to([FORWARD], (2, 3, 2)))
        ground = [0.0 if i in at else -10.0 for i in range(3)]
        assert rewards[1].tolist() == [a + b for a, b in zip(shares, ground, strict=True)]
        assert engine.team_rewards[1] == 1e5 + sum(ground) and terminated.all()


def test_walls_of_failed_robots_cost_nothing() -> None:
    for reward, expected in [("released", [0.0, -10.0, -10.0]), ("formal", [0.0, 0.0, 0.0])]:
        failing = Failures(at={0: 3}, kind="coast")
        engine = started(failures=failing, f_max=15.0, v_clip=15.0, reward=reward)
        away = np.array([(-0.5, 0.0), (0.1, 0.0), (0.1, 0.0)])
        go(engine, away, away)
        assert engine.metrics()["wall_hits"].tolist() == [[1, 0, 0]] * 2  # at 20 - 7.5 - 15
        engine = started(failures=failing, f_max=15.0, v_clip=7.5, reward=reward)
        go(engine, away, away)
        _, rewards, _, _ = engine.step(np.broadcast_to(away, (2, 3, 2)))
        assert engine.metrics()["wall_hits"].tolist() == [[0, 0, 0]] * 2
        assert velocities(engine)[0] == [0.0, 0.0]  # 20 - 3 x 7.5 is outside
        assert rewards[1].tolist() == expected


@pytest.mark.parametrize("kind", ["brake", "coast", "vanish"])
def test_failed_robots_collide_and_visit_unless_they_have_vanished(kind: Any) -> None:
    failing = Failures(at={0: 1}, kind=kind)
    field = Field(vertices=SQUARE.vertices, rois=[(15.0, 50.0), (90.0, 90.0)], starts=SQUARE.starts)
    there = kind != "vanish"
    engine = started(field, failures=failing)
    go(engine, STILL)
    assert engine.snapshot().visited.tolist() == [there, False]
    starts = [(20.0, 50.0), (31.0, 50.0), (80.0, 50.0)]
    engine = started(field, starts=starts, failures=failing, f_max=2.0)
    _, rewards, terminated, _ = engine.step(np.broadcast_to((-1.0, 0.0), (2, 3, 2)))
    assert terminated.tolist() == [there] * 2
    assert rewards[0].tolist() == ([0.0, -5e4, -5e4] if there else [0.0, -10.0, -10.0])


def test_a_vanished_robot_stays_in_the_memory_where_it_vanished() -> None:
    starts = np.array([(20.0, 50.0), (50.0, 50.0), (80.0, 20.0)])
    failing = Failures(at={0: 1}, kind="vanish")
    engine = started(starts=starts, f_max=40.0, v_clip=40.0, failures=failing)
    actions = [STILL, (-0.75, 0.0), STILL]
    _, rewards, _, _ = engine.step(np.broadcast_to(actions, (2, 3, 2)))
    assert engine.snapshot().positions[1].tolist() == [20.0, 50.0]
    assert rewards[0].tolist() == [0.0, -100.0, -10.0]


@pytest.mark.parametrize("observation", SIGHTS)
def test_every_observation_shows_who_has_failed(observation: str) -> None:
    for kind in ("brake", "vanish"):
        failing = Failures(at={0: 2}, kind=kind)
        settings = seeing(observation, 1000.0)
        engine = started(failures=failing, **settings)
        go(engine, FORWARD, FORWARD)
        first, last = entries(engine, 0), entries(engine, 2)
        blank = kind == "vanish" and observation == "entities"
        names = ["own_failed", "other_1_failed", "other_2_failed"]
        assert {name for name in first if name.endswith("failed")} == {*names}
        assert [first[name] for name in names] == [1.0, 0.0, 0.0]
        assert [last[name] for name in names] == [0.0, float(not blank), 0.0]
        seen = {name: value for name, value in last.items() if name.startswith("other_1")}
        shown = [name for name, value in seen.items() if value]
        hidden = kind == "vanish" and observation != "state"
        assert shown == ["other_1_failed"] * (not blank) if hidden else len(shown) >= 2
        assert any(value for name, value in first.items() if name.startswith("own_")) is True
    if observation in ("local", "lidar_local"):
        engine = started(observation=observation, failures=Failures(at={0: 1}), sensing_radius=9.0)
        far = entries(go(engine, STILL), 2)
        assert {name for name, value in far.items() if value and name.startswith("other")} == {
            "other_1_failed"
        }


def test_the_state_has_flags_before_the_visit_code() -> None:
    engine = go(started(failures=Failures(at={1: 1})), STILL)
    assert engine.state()[0, 15:].tolist() == [0.0, 1.0, 0.0, 0.0]
    assert engine.state_high[15:].tolist() == [1.0, 1.0, 1.0, 3.0]
    assert engine.state_low[15:].tolist() == [0.0] * 4


def test_measured_robots_fail_alike() -> None:
    """Robots that are moved as commanded have the episode that the engine gives them."""
    options = {**EVERYTHING, "failures": Failures(at={0: 2, 2: 4}, kind="coast")}
    plain = BatchEngine(SQUARE, 1, autoreset=False, threads=1, **options)
    tracked = BatchEngine(SQUARE, 1, autoreset=False, threads=1, **options)
    plain.reset(), tracked.reset()
    world = TrackedWorld(tracked)
    for action in np.random.default_rng(1).uniform(-1, 1, (8, 3, 2)):
        plain.step(action[None])
        command = world.command(action)
        world.measure(tracked.snapshot().positions + command.velocities, command.velocities)
        assert np.array_equal(plain.state(), tracked.state())
        assert np.array_equal(plain.infos(), tracked.infos())
    assert tracked.snapshot().failed.tolist() == [True, False, True]


def test_no_plan_and_no_bound_is_for_robots_that_fail() -> None:
    field = Field(**{**SQUARE.to_dict(), "optimal_makespan": 20, "starts": SQUARE.starts})
    assert optimal_return(field) is not None
    config = make_config({"failures": Failures()})
    assert optimal_return(field, config) is None
    with pytest.raises(ConfigError, match="failures"):
        make_problem(field, config)
