"""Bad input to ``BatchEngine``: a clear error that names the offender, and nothing has changed."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from mbn_marl import BatchEngine, Field, load_field, parallel_env
from mbn_marl.config import NavigationConfig, RewardProfile, make_config
from mbn_marl.engine.mdp.revisits import ODD_LINES
from mbn_marl.errors import ActionError, ConfigError, FieldError, StepError

W, N = 4, 3
FIELD = "field_03"


def make_engine(**settings: Any) -> BatchEngine:
    """A small engine, some steps into its first episodes."""
    engine = BatchEngine(FIELD, W, **{"max_steps": 25, **settings})
    engine.reset()
    for _ in range(7):
        engine.step(engine.sample_actions())
    return engine


def observable(engine: BatchEngine) -> list[bytes]:
    """Everything that the engine tells about itself, as bytes."""
    arrays = [
        engine.state(),
        engine.team_rewards,
        engine.reward_terms(),
        *engine.metrics().values(),
    ]
    snapshots = [engine.snapshot(world) for world in range(W)]
    arrays += [array for shot in snapshots for array in (shot.trail, shot.visited, shot.velocities)]
    return [array.tobytes() for array in arrays]


def check_refused(
    engine: BatchEngine,
    call: Callable[[BatchEngine], object],
    error: type[Exception],
    *words: str,
) -> None:
    """``call`` raises ``error`` with all ``words``, and the engine continues as if never called."""
    twin = copy.deepcopy(engine)
    before = observable(engine)
    with pytest.raises(error) as caught:
        call(engine)
    for word in words:
        assert word in str(caught.value)
    assert observable(engine) == before
    for _ in range(40):
        actions = twin.sample_actions()
        assert engine.sample_actions().tobytes() == actions.tobytes()
        for got, expected in zip(engine.step(actions), twin.step(actions), strict=True):
            assert got.tobytes() == expected.tobytes()
        assert observable(engine) == observable(twin)


def actions_with(value: float, world: int, robot: int, dtype: str = "float32") -> Any:
    actions = np.zeros((W, N, 2), dtype)
    actions[world, robot, 1] = value
    return actions


BAD_ACTIONS = {
    "one world": (np.zeros((N, 2)), ["(3, 2)", "(4, 3, 2)"]),
    "too many worlds": (np.zeros((W + 1, N, 2)), ["(5, 3, 2)", "(4, 3, 2)"]),
    "too few robots": (np.zeros((W, N - 1, 2)), ["(4, 2, 2)", "(4, 3, 2)"]),
    "three axes": (np.zeros((W, N, 3)), ["(4, 3, 3)", "(4, 3, 2)"]),
    "flat": (np.zeros(W * N * 2), ["(24,)", "(4, 3, 2)"]),
    "nothing": (None, ["(4, 3, 2)"]),
    "ragged": ([[[0.0, 0.0]] * N] * (W - 1) + [[[0.0]]], ["(4, 3, 2)"]),
    "complex": (np.zeros((W, N, 2), np.complex128), ["complex128"]),
    "text": (np.full((W, N, 2), "up"), ["<U2"]),
    "objects": (np.full((W, N, 2), None), ["object"]),
    "truth": (np.ones((W, N, 2), np.bool_), ["bool"]),
    "NaN": (actions_with(np.nan, 2, 1), ["world 2", "robot_1", "nan"]),
    "infinity": (actions_with(np.inf, 3, 0), ["world 3", "robot_0", "inf"]),
    "minus infinity": (actions_with(-np.inf, 0, 2), ["world 0", "robot_2", "inf"]),
    "NaN, other precision": (actions_with(np.nan, 1, 2, "float64"), ["world 1", "robot_2", "nan"]),
    "NaN in a view": (actions_with(np.nan, 1, 0)[:, ::-1], ["world 1", "robot_2", "nan"]),
}


@pytest.mark.parametrize("autoreset", ["same_step", "next_step"])
@pytest.mark.parametrize("case", BAD_ACTIONS)
def test_bad_actions(case: str, autoreset: Any) -> None:
    actions, words = BAD_ACTIONS[case]
    engine = make_engine(autoreset=autoreset)
    check_refused(engine, lambda engine: engine.step(actions), ActionError, "actions", *words)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_huge_finite_actions_are_clipped(dtype: Any) -> None:
    huge, full = make_engine(dtype=dtype), make_engine(dtype=dtype)
    huge.step(np.full((W, N, 2), -1e300))
    full.step(np.full((W, N, 2), -1.0))
    assert observable(huge) == observable(full)


@pytest.mark.parametrize("kind", ["float16", "float32", "float64", "int8", "int64", "uint8"])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_every_real_type_is_taken_and_left_alone(kind: str, dtype: Any) -> None:
    given = np.ones((W, N, 2), kind)
    engine, expected = make_engine(dtype=dtype), make_engine(dtype=dtype)
    engine.step(given)
    expected.step(np.ones((W, N, 2), dtype))
    assert observable(engine) == observable(expected)
    assert (given == 1).all()


def test_step_before_reset() -> None:
    engine = BatchEngine(FIELD, W)
    with pytest.raises(StepError, match=r"world 0 was never reset.*reset\(\)"):
        engine.step(np.zeros((W, N, 2)))
    fresh = BatchEngine(FIELD, W)
    assert engine.reset().tobytes() == fresh.reset().tobytes()
    assert observable(engine) == observable(fresh)


def test_step_with_worlds_that_were_never_reset() -> None:
    engine = BatchEngine(FIELD, W)
    engine.reset_worlds(np.array([True, True, False, True]))
    with pytest.raises(StepError, match="world 2 was never reset"):
        engine.step(np.zeros((W, N, 2)))


def ended_engine() -> BatchEngine:
    """Worlds that wait for a reset: all but 1 and 3, which were reset after the end."""
    engine = BatchEngine(FIELD, W, autoreset=False, max_steps=5)
    engine.reset()
    for _ in range(5):
        _, _, terminated, truncated = engine.step(np.zeros((W, N, 2)))
    assert (terminated | truncated).all()
    engine.reset_worlds(np.array([False, True, False, True]))
    return engine


def test_step_after_the_end() -> None:
    engine = ended_engine()
    before = observable(engine)
    with pytest.raises(StepError, match=r"world 0 has ended.*reset"):
        engine.step(np.zeros((W, N, 2)))
    assert observable(engine) == before
    engine.reset_worlds(np.array([True, False, True, False]))
    engine.step(np.zeros((W, N, 2)))
    assert engine.metrics()["steps"].tolist() == [1, 1, 1, 1]


def test_ended_worlds_can_be_left_out() -> None:
    engine = ended_engine()
    before = [engine.snapshot(world) for world in range(W)]
    _, rewards, terminated, truncated = engine.step(
        np.ones((W, N, 2)), active=np.array([False, True, False, True])
    )
    assert not (terminated | truncated).any()
    assert engine.metrics()["steps"].tolist() == [5, 1, 5, 1]
    for world, old in enumerate(before):
        new = engine.snapshot(world)
        if world in (1, 3):
            assert (new.positions != old.positions).all()
            assert (rewards[world] != 0).all()
        else:
            assert (rewards[world] == 0).all()
            for name in ("positions", "velocities", "visited", "trail"):
                np.testing.assert_array_equal(getattr(new, name), getattr(old, name), name)
            assert (new.step, new.team_return) == (old.step, old.team_return)


@pytest.mark.parametrize(
    ("active", "error", "words"),
    [
        (np.ones(W, np.bool_), StepError, "world 0 has ended"),
        (np.zeros(W, np.bool_), StepError, "world 1 is left out"),
        (np.ones(W - 1, np.bool_), ActionError, r"active: shape \(3,\).*\(4,\)"),
        (np.ones(W, np.int64), ActionError, "active:.*int64.*bool"),
    ],
)
def test_bad_active_mask(active: Any, error: type[Exception], words: str) -> None:
    engine = ended_engine()
    before = observable(engine)
    with pytest.raises(error, match=words):
        engine.step(np.zeros((W, N, 2)), active=active)
    assert observable(engine) == before


@pytest.mark.parametrize("autoreset", ["same_step", "next_step"])
def test_no_world_is_left_out_where_worlds_restart(autoreset: Any) -> None:
    engine, active = make_engine(autoreset=autoreset), np.ones(W, np.bool_)
    words = "active", autoreset, "allowed: None", "disabled"
    zeros = np.zeros((W, N, 2))
    check_refused(engine, lambda engine: engine.step(zeros, active), ActionError, *words)


@pytest.mark.parametrize(
    ("mask", "words"),
    [
        (np.ones(W + 1, np.bool_), ["(5,)", "(4,)"]),
        (np.ones((W, 1), np.bool_), ["(4, 1)", "(4,)"]),
        (np.ones(W, np.int32), ["int32", "bool"]),
        (True, ["()", "(4,)"]),
        ([[True], [True, False]], ["allowed: (4,) of bool"]),
    ],
)
def test_bad_reset_mask(mask: Any, words: list[str]) -> None:
    check_refused(
        make_engine(), lambda engine: engine.reset_worlds(mask), ActionError, "mask", *words
    )


@pytest.mark.parametrize("seed", [-1, 2**63, 1.5, "seven", float("nan")])
def test_bad_seed(seed: Any) -> None:
    check_refused(
        make_engine(),
        lambda engine: engine.reset(seed),
        ConfigError,
        "seed",
        repr(seed),
        "2**63 - 1",
    )
    with pytest.raises(ConfigError, match="seed"):
        BatchEngine(FIELD, W, seed=seed)


@pytest.mark.parametrize("world", [-1, W, 10**9])
def test_snapshot_of_an_unknown_world(world: int) -> None:
    with pytest.raises(IndexError, match=rf"world {world}; allowed: 0 to 3"):
        make_engine().snapshot(world)


BAD_SETTINGS: dict[str, tuple[dict[str, Any], list[str]]] = {
    "unknown setting": ({"gravity": 9.81}, ["gravity", "unknown", "wind", "max_steps"]),
    "wind not finite": ({"wind": (float("nan"), 0.0)}, ["wind", "finite"]),
    "wind without angle": ({"wind": (1.0,)}, ["wind"]),
    "negative wind": ({"wind": (-1.0, 0.0)}, ["wind", "0"]),
    "unknown reward": ({"reward": "greedy"}, ["reward", "greedy", "released", "formal"]),
    "unknown sharing": ({"reward_sharing": "all"}, ["reward_sharing", "individual", "team"]),
    "unknown observation": (
        {"observation": "pixels"},
        ["observation", "relative", "state", "local", "lidar", "lidar_local", "entities"],
    ),
    "assignment of others": ({"assignment": True}, ["assignment", "observation='entities'"]),
    "unknown dtype": ({"dtype": "float16"}, ["dtype", "float32", "float64"]),
    "no steps": ({"max_steps": 0}, ["max_steps", "1"]),
    "no robots": ({"n_robots": 0}, ["n_robots", "1"]),
    "too many robots": ({"n_robots": 4}, ["n_robots", "4", "3"]),
    "no mass": ({"mass": 0.0}, ["mass", "0"]),
    "masses of others": ({"mass": (1.0, 2.0)}, ["mass", "2", "3"]),
    "no time": ({"tau": 0.0}, ["tau", "0"]),
    "no time in float32": ({"tau": 1e-46}, ["tau", "0.000000000001"]),
    "no limit in float32": ({"v_clip": 1e-46, "mass": 1e-46}, ["v_clip", "mass", "0.000000000001"]),
    "no number in float32": ({"f_max": 1e39, "gust": 1e39}, ["f_max", "gust", "1000000000000"]),
    "angle of no wind": ({"wind": (0.1, -1e39)}, ["wind.1", "-1000000000000"]),
    "reward of no number": (
        {"reward": {"name": "mine", "large": 1e39}},
        ["reward.large", "1000000000000"],
    ),
    "safety beyond the starts": ({"safety_distance": 500.0}, ["safety_distance", "500"]),
    "no worlds": ({"num_worlds": 0}, ["num_worlds", "0", "at least 1"]),
    "half a world": ({"num_worlds": 1.5}, ["num_worlds", "1.5"]),
    "no threads": ({"threads": 0}, ["threads", "0", "at least 1"]),
    "unknown autoreset": ({"autoreset": "sometimes"}, ["autoreset", "sometimes", "next_step"]),
    "two at once": ({"tau": -1.0, "f_max": float("inf")}, ["2 problems", "tau", "f_max"]),
}


@pytest.mark.parametrize("case", BAD_SETTINGS)
def test_bad_settings(case: str) -> None:
    settings, words = BAD_SETTINGS[case]
    with pytest.raises(ConfigError) as caught:
        BatchEngine(FIELD, **settings)
    for word in words:
        assert word in str(caught.value)


def test_unknown_field() -> None:
    with pytest.raises(FieldError, match="field_99") as caught:
        BatchEngine("field_99")
    assert "field_03" in str(caught.value)


def test_fields_of_different_arenas() -> None:
    field = load_field(FIELD)
    other = Field(field.vertices, field.rois, field.starts, arena=(500.0, 400.0))
    with pytest.raises(ConfigError, match=r"arena.*500.*1000"):
        BatchEngine([field, other])


def test_no_fields() -> None:
    with pytest.raises(ConfigError, match="at least one field"):
        BatchEngine([])


@pytest.mark.parametrize(("robots", "limit"), [(1, 256), (2, 256), (2, 64), (3, 250)])
def test_the_filter_of_visited_ground_stays_in_its_memory(robots: int, limit: int) -> None:
    """At the time limit a world holds one position more for each robot than there are steps."""
    engine = BatchEngine(
        "field_03", 2, n_robots=robots, max_steps=limit, safety_distance=0.0, autoreset=False
    )
    engine.reset()
    actions = np.zeros((2, robots, 2))
    for _ in range(limit):
        *_, truncated = engine.step(actions)
    assert truncated.all()
    memory = engine._backend.memory
    assert memory.words.max() <= memory.filter.shape[1] - ODD_LINES


@pytest.mark.parametrize("autoreset", ["disabled", "next_step"])
@pytest.mark.parametrize(("robots", "limit"), [(1, 127), (3, 84)])
def test_a_world_that_waits_leaves_the_memory_of_others_alone(
    robots: int, limit: int, autoreset: Any
) -> None:
    """A step more than the time limit would need a larger filter than there is room for."""
    how = {"n_robots": robots, "max_steps": limit, "safety_distance": 0.0, "autoreset": autoreset}
    engine = BatchEngine(FIELD, 2, **how)
    engine.reset()
    rng = np.random.default_rng(0)
    for step in range(limit):
        if step == limit - 20:
            engine.reset_worlds(np.array([False, True]))
        *_, truncated = engine.step(rng.uniform(-0.1, 0.1, (2, robots, 2)))
    assert truncated.tolist() == [True, False]
    filters = engine._backend.memory.filter
    before = filters[1].copy()
    active = np.array([False, True]) if autoreset == "disabled" else None
    engine.step(rng.uniform(-0.1, 0.1, (2, robots, 2)), active)
    assert 0 < np.count_nonzero(filters[1] != before) <= robots


def test_a_world_that_is_left_out_keeps_its_outcome() -> None:
    field = Field([(0, 0), (90, 0), (90, 90), (0, 90)], [(22, 20)], [(20, 20), (20, 50)])
    engine = BatchEngine(field, 2, autoreset=False, roi_radius=5.0)
    engine.reset()
    engine.reset_worlds(np.array([False, True]))
    still = np.zeros((2, 2, 2))
    _, _, terminated, _ = engine.step(still)
    assert terminated.all()
    engine.reset_worlds(np.array([False, True]))
    before = engine.snapshot(0)
    engine.step(still, np.array([False, True]))
    after = engine.snapshot(0)
    assert (before.success, before.collision) == (after.success, after.collision) == (True, False)
    assert not before.judged().collision
    near = Field(field.vertices, [(80, 80)], [(20, 20), (20, 40)])
    engine = BatchEngine(near, 2, autoreset=False, safety_distance=19.0)
    engine.reset()
    toward = np.array([[[0.0, 1.0], [0.0, -1.0]]] * 2)
    while engine.running[0]:
        engine.step(toward)
    engine.reset_worlds(np.array([False, True]))
    engine.step(still, np.array([False, True]))
    assert engine.snapshot(0).collision and not engine.snapshot(0).success


@pytest.mark.parametrize("dtype", ["longdouble", ">f4", "<f2"])
def test_finite_actions_of_any_real_type_are_taken(dtype: str) -> None:
    engine = make_engine()
    engine.step(np.zeros((W, N, 2), dtype))
    with pytest.raises(ActionError, match="finite"):
        engine.step(np.full((W, N, 2), np.nan, dtype))


def test_ragged_starts_are_named() -> None:
    with pytest.raises(ConfigError, match=r"starts: .*allowed"):
        BatchEngine(FIELD, 1, starts=[[1, 2], [3]])  # type: ignore[list-item]
    env = parallel_env(FIELD)
    with pytest.raises(ConfigError, match=r"starts: .*allowed"):
        env.reset(options={"starts": [[1, 2], [3]]})


@pytest.mark.parametrize("model", [RewardProfile, NavigationConfig])
def test_a_model_lists_all_its_problems(model: Any) -> None:
    with pytest.raises(ConfigError) as caught:
        model(name=3, medium=-1, tau=-1.0, colour="red")
    places = {problem.partition(":")[0] for problem in caught.value.problems}
    own = {"name", "medium"} if model is RewardProfile else {"tau"}
    assert own < places and "colour" in places


def test_a_problem_of_a_profile_is_named_within_the_configuration() -> None:
    with pytest.raises(ConfigError) as caught:
        BatchEngine(FIELD, reward={"name": "mine", "medium": -1.0}, tau=-1.0)
    assert {problem.partition(":")[0] for problem in caught.value.problems} == {
        "reward.medium",
        "tau",
    }
    assert RewardProfile(name="mine", medium=3).medium == 3.0
    assert make_config({"reward": {"name": "mine"}}).reward == RewardProfile(name="mine")
