"""Bad input to ``BatchEngine``: an error that names the place, and nothing has changed."""

import copy
import json
import math
from typing import Any

import numpy as np
import pytest
import torch

from mbn_marl import (
    BatchEngine,
    Failures,
    Field,
    FieldSampler,
    Uniform,
    centralized_env,
    load_field,
    parallel_env,
    raw_env,
)
from mbn_marl.adapters.sb3 import CentralizedVecEnv, SharedPolicyVecEnv
from mbn_marl.adapters.torchrl import NavigationEnv
from mbn_marl.config import WITHOUT_RADIUS, NavigationConfig, RewardProfile, Settings, make_config
from mbn_marl.engine.batch import METRICS
from mbn_marl.engine.mdp.revisits import ODD_LINES
from mbn_marl.errors import ActionError, ConfigError, FieldError, StepError
from tests.support.configurations import PRECISIONS
from tests.support.configurations import SAMPLER as ALL
from tests.support.problems import places_of

W, N = 4, 3
FIELD = "field_03"
STILL = np.zeros((W, N, 2))


def make_engine(**settings: Any) -> BatchEngine:
    engine = BatchEngine(FIELD, W, **{"max_steps": 25, **settings})
    engine.reset()
    for _ in range(7):
        engine.step(engine.sample_actions())
    return engine


def observable(engine: BatchEngine) -> list[bytes]:
    arrays = [engine.state(), engine.team_rewards, engine.reward_terms()]
    arrays += engine.metrics().values()
    snapshots = [engine.snapshot(world) for world in range(W)]
    arrays += [array for shot in snapshots for array in (shot.trail, shot.visited, shot.velocities)]
    return [array.tobytes() for array in arrays]


def actions_with(value: float, world: int, robot: int, dtype: str = "float32") -> Any:
    actions = np.zeros((W, N, 2), dtype)
    actions[world, robot, 1] = value
    return actions


BAD_ACTIONS = [
    (np.zeros((N, 2)), ["(3, 2)", "(4, 3, 2)"]),
    (np.zeros((W, N, 3)), ["(4, 3, 3)"]),
    (None, []),
    ([[[0.0, 0.0]] * N] * (W - 1) + [[[0.0]]], []),
    (np.zeros((W, N, 2), np.complex128), ["complex128"]),
    (np.full((W, N, 2), "up"), ["<U2"]),
    (np.ones((W, N, 2), np.bool_), ["bool"]),
    (actions_with(np.nan, 2, 1), ["world 2", "robot_1"]),
    (actions_with(np.inf, 3, 0), ["world 3", "robot_0"]),
    (actions_with(np.nan, 1, 2, "float64"), ["world 1", "robot_2"]),
    (actions_with(np.nan, 1, 0)[:, ::-1], ["world 1", "robot_2"]),
    *((np.full((W, N, 2), np.nan, kind), ["world 0"]) for kind in ("longdouble", ">f4", "<f2")),
]
BAD_MASKS = [
    (np.ones(W + 1, np.bool_), ["(5,)", "(4,)"]),
    (np.ones(W, np.int32), ["int32"]),
    (True, ["()"]),
    ([[True], [True, False]], []),
]
BAD_SEEDS = [-1, 2**63, 1.5, "seven", float("nan"), True]
BAD_CALLS = [
    *((lambda e, a=a: e.step(a), ActionError, ["actions", *w]) for a, w in BAD_ACTIONS),
    *((lambda e, m=m: e.reset_worlds(m), ActionError, ["mask", *w]) for m, w in BAD_MASKS),
    *((lambda e, s=s: e.reset(s), ConfigError, ["seed", repr(s)]) for s in BAD_SEEDS),
    *((lambda e, w=w: e.snapshot(w), IndexError, [f"world {w}"]) for w in (-1, W, 10**9)),
    (lambda e: e.step(STILL, np.ones(W, np.bool_)), ActionError, ["active"]),
    (lambda e: e.metrics(["sucess", "steps", 7]), ConfigError, ["'sucess'", "7:"]),
    (lambda e: e.metrics("success"), ConfigError, ["names:"]),
]


@pytest.mark.parametrize("autoreset", ["same_step", "next_step"])
def test_bad_calls_change_nothing(autoreset):
    engine = make_engine(autoreset=autoreset)
    twin, before = copy.deepcopy(engine), observable(engine)
    for call, error, words in BAD_CALLS:
        with pytest.raises(error) as caught:
            call(engine)
        assert all(word in str(caught.value) for word in words), (words, caught.value)
        assert observable(engine) == before, words
    for _ in range(40):
        actions = twin.sample_actions()
        assert engine.sample_actions().tobytes() == actions.tobytes()
        for got, expected in zip(engine.step(actions), twin.step(actions), strict=True):
            assert got.tobytes() == expected.tobytes()
        assert observable(engine) == observable(twin)
    assert tuple(engine.metrics()) == METRICS


@pytest.mark.parametrize("dtype", PRECISIONS)
def test_actions_of_every_real_type_are_accepted_unchanged(dtype):
    def told(actions: Any) -> list[bytes]:
        engine = make_engine(dtype=dtype)
        engine.step(actions)
        return observable(engine)

    expected = told(np.ones((W, N, 2), dtype))
    for kind in ("int8", "uint8", "float16", "float32", "float64", "longdouble", ">f4"):
        given = np.ones((W, N, 2), kind)
        assert told(given) == expected, kind
        assert (given == 1).all(), kind
    assert told(np.full((W, N, 2), -1e300)) == told(np.full((W, N, 2), -1.0))


def test_step_before_reset():
    engine, fresh = BatchEngine(FIELD, W), BatchEngine(FIELD, W)
    for mask, world in (([False] * 4, 0), ([True, True, False, True], 2)):
        engine.reset_worlds(np.array(mask))
        with pytest.raises(StepError, match=f"world {world} was never reset"):
            engine.step(STILL)
    assert engine.reset(seed=1).tobytes() == fresh.reset(seed=1).tobytes()
    assert observable(engine) == observable(fresh)


def ended_engine() -> BatchEngine:
    engine = BatchEngine(FIELD, W, autoreset=False, max_steps=5)
    engine.reset()
    for _ in range(5):
        _, _, terminated, truncated = engine.step(STILL)
    assert (terminated | truncated).all()
    engine.reset_worlds(np.array([False, True, False, True]))
    return engine


def test_step_after_the_end():
    engine = ended_engine()
    before = observable(engine)
    for active, error, place in (
        (None, StepError, "world 0 has ended"),
        (np.ones(W, np.bool_), StepError, "world 0 has ended"),
        (np.zeros(W, np.bool_), StepError, "world 1 is left out"),
        (np.ones(W - 1, np.bool_), ActionError, "active: "),
        (np.ones(W, np.int64), ActionError, "active: "),
    ):
        with pytest.raises(error, match=place):
            engine.step(STILL, active)
        assert observable(engine) == before
    engine.reset_worlds(np.array([True, False, True, False]))
    engine.step(STILL)
    assert engine.metrics()["steps"].tolist() == [1, 1, 1, 1]


def test_ended_worlds_can_be_skipped():
    engine = ended_engine()
    before = [engine.snapshot(world) for world in range(W)]
    _, rewards, terminated, truncated = engine.step(
        np.ones((W, N, 2)), active=np.array([False, True, False, True])
    )
    assert not (terminated | truncated).any()
    assert engine.metrics()["steps"].tolist() == [5, 1, 5, 1]
    for world, old in enumerate(before):
        new, went_on = engine.snapshot(world), world in (1, 3)
        assert (rewards[world] != 0).tolist() == [went_on] * N
        for name in ("positions", "velocities", "trail", "step", "team_return"):
            assert np.array_equal(getattr(new, name), getattr(old, name)) != went_on, name


OWN = {"observation": "entities", "knowledge": "own"}
STRICT = "mass.1 mass.2 max_steps one_hot"
LATE = Failures(rate=0.1, most=0, between=(1001, 1002))
BAD_SETTINGS = [
    ({"gravity": 9.81, "wind": (math.nan, 0.0), "reward": "greedy"}, "gravity wind.0 reward"),
    ({"wind": Uniform(0.1, 0.3), "failures": {"between": {5, 60}}}, "wind failures.between"),
    ({"wind": (1.0,), "reward_sharing": "all"}, "wind.1 reward_sharing"),
    ({"wind": (-1.0, -1e39), "observation": "pixels"}, "wind.0 wind.1 observation"),
    ({"assignment": True, "dtype": "float16", "max_steps": 0}, "assignment dtype max_steps"),
    *(({"sensing_radius": 60, "observation": one}, "sensing_radius") for one in WITHOUT_RADIUS),
    ({"n_robots": 0, "mass": 0.0, "tau": 0.0}, "n_robots mass tau"),
    ({"n_robots": 4}, "n_robots"),
    ({"mass": (1.0, 2.0), "dynamics": ("unicycle",) * 2}, "mass dynamics"),
    ({"v_clip": 1e-46, "mass": 1e-46, "tau": 1e-46}, "v_clip mass tau"),
    ({"f_max": 1e39, "gust": 1e39}, "f_max gust"),
    ({"reward": {"name": "mine", "large": 1e39, "medium": -1}}, "reward.large reward.medium"),
    ({"dynamics": "hovercraft", "v_clip": (1.0, -1.0)}, "dynamics v_clip.1"),
    ({"dynamics": ("mixed",), "mass": [-1.0], "steer_max": 1.6}, "dynamics.0 mass.0 steer_max"),
    ({"gust": -0.1, "gust_time": 0.0, "position_noise": math.nan}, "gust gust_time position_noise"),
    ({"action_loss": 1.1, "action_delay": 101, "dropout": -1}, "action_loss action_delay dropout"),
    ({"gust": Uniform(-1.0, 1.0), "mass": (1.0, Uniform(0.0, 1.0))}, "gust mass.1"),
    ({"mass": {0: 1.0, 1: 2.0}, "failures": {1: 5}, "reward": {2: 3}}, "mass failures reward"),
    ({"tau": {"low": 2, "high": 1}, "max_steps": Uniform(1.0, 2.0)}, "tau.high max_steps"),
    ({"wind": (0.1, {"low": 2, "top": 3})}, "wind.1.high wind.1.top"),
    ({"n_robots": True, "random_starts": 1, "mass": []}, "n_robots random_starts mass"),
    ({"mass": (1.0, True, "2"), "max_steps": "9", "one_hot": "yes"}, STRICT),
    ({"gust": {"low": True, "high": 2}, "n_robots": "3"}, "gust.low n_robots"),
    ({"failures": {"between": (3, 1), "kind": "stop"}}, "failures.between failures.kind"),
    ({"failures": {"rate": 2, "at": {64: 0}}}, "failures.rate failures.at.64.[key] failures.at.64"),
    ({"failures": {"at": {0: 1001, 3: 2}, "most": 4}}, "failures.at failures.at.0 failures.most"),
    ({"failures": LATE}, "failures.between failures.most"),
    ({"n_robots": 1, "failures": Failures(rate=0.1)}, "failures.most"),
    ({"field": ALL, "n_robots": 3, "safety_distance": 14.0}, "n_robots safety_distance"),
    ({"field": ALL, "starts": np.zeros((4, 2))}, "starts"),
    ({"safety_distance": 500.0}, "safety_distance"),
    *(({"starts": starts}, "starts") for starts in ([[1, 2], [3]], np.zeros((2, 2)))),
    *(({"num_worlds": count}, "num_worlds") for count in (0, 1.5, 10**12)),
    ({"max_steps": 10**6, "num_worlds": 2**31 - 1}, "num_worlds"),  # no machine has room
    ({"first_world": True, "threads": 0, "device": "tpu"}, "first_world threads device"),
    ({"autoreset": "sometimes"}, "autoreset"),
    *(({"seed": seed}, "seed") for seed in BAD_SEEDS),
    ({"knowledge": "own"}, "knowledge"),
    ({"knowledge": "own", "observation": "state"}, "knowledge"),
    ({**OWN, "assignment": True}, "knowledge"),
    *(({name: 1}, name) for name in ("comm_radius", "look_radius", "comm_delay", "decoys")),
    ({"comm_loss": 0.1}, "comm_loss"),
    *(({**OWN, "comm_radius": radius}, "comm_radius") for radius in (math.nan, -1.0)),
    *(({**OWN, "decoys": decoys}, "decoys") for decoys in ((3, 1), (1, 2, 3), 24, 6)),
    ({"empty_rois": (1,)}, "empty_rois"),
    ({**OWN, "decoys": 1, "empty_rois": (1,)}, "empty_rois"),
    *(({**OWN, "empty_rois": rois}, "empty_rois") for rois in ((6,), range(6))),
    ({**OWN, "empty_rois": (-1,)}, "empty_rois.0"),
    ({**OWN, "decoys": 3, "field": FieldSampler(rois=(3, 9))}, "decoys"),
]


def test_bad_settings():
    for settings, places in BAD_SETTINGS:
        found = places_of(ConfigError, BatchEngine, **{"field": FIELD, **settings})
        assert {*found} == {*places.split()}, settings
    with pytest.raises(ConfigError, match="starts"):
        parallel_env(FIELD).reset(options={"starts": [[1, 2], [3]]})


def test_bad_fields():
    field = load_field(FIELD)
    other = Field(field.vertices, field.rois, field.starts, arena=(500.0, 400.0))
    for given, error, place in (
        ("field_99", FieldError, "field_99"),
        ([field, other], ConfigError, "arena"),
        ([], ConfigError, "field"),
        ([FIELD] * 4097, ConfigError, "field: 4097 fields; allowed: up to 4096"),
        (["field_98", FIELD, "field_99"], FieldError, "field_98(.|\n)*field_99"),
        ("random_convex", FieldError, "random_convex: .*\n.*load_fields"),
    ):
        with pytest.raises(error, match=place):
            BatchEngine(given)


def test_all_arguments_are_checked_at_once():
    wrong = {"autoreset": "x", "threads": 0, "mass": -1}
    places = places_of(ConfigError, BatchEngine, "field_03", 0, **wrong)
    assert places == ["mass", "num_worlds", "threads", "autoreset"]
    for form in (BatchEngine, NavigationEnv, SharedPolicyVecEnv):
        places = places_of(FieldError, form, "field_99", 0, mass=-1, threads=0)
        assert places[1:] == ["settings"] * 3
    places = places_of(FieldError, centralized_env, "field_99", render_mode="x", flat=0, tau=0)
    assert places[1:] == ["settings"] * 3
    starts = torch.zeros(3, 2, requires_grad=True)
    with pytest.raises(ConfigError, match=r"starts\[1\]: "):
        BatchEngine("field_03", 1, starts=starts)
    with pytest.raises(ConfigError, match=r"starts\[2\]: .*nan"):
        BatchEngine("field_03", 1, starts=[(120.0, 120.0), (150.0, 150.0), (np.nan, 1.0)])
    with pytest.raises(ConfigError, match=r"starts: (.|\n)*random_starts"):
        BatchEngine(FIELD, 1, starts=load_field(FIELD).starts, random_starts=True)


def test_what_only_one_mode_keeps_is_refused_in_others():
    engine = BatchEngine("field_03", 2, autoreset="next_step")
    engine.reset()
    for read in (engine.final_state, engine.final_drawn, lambda: engine.final_observations):
        with pytest.raises(ConfigError, match="autoreset: 'next_step'; allowed: 'same_step'"):
            read()
    for world in (-1, 2):
        with pytest.raises(IndexError, match="allowed: 0 to 1"):
            engine.config_in(world)


def test_calls_that_do_not_fit_the_engine_are_refused():
    engine, drawn = BatchEngine(FIELD, 1), BatchEngine(FieldSampler(), 1)
    engine.set_field(FIELD)
    calls = (
        (lambda: engine.set_sampler(None), "sampler: allowed in place of another"),
        (lambda: drawn.set_sampler(None), "sampler: NoneType; allowed"),
        (engine.knowledge, "knowledge: 'team'; allowed: 'own'"),
        (lambda: make_config({"assignment": "x"}), "known: False, True, fresh"),
        (lambda: make_config({"wind": 0.1}), r"wind: .*\(speed, angle\) \(got 0.1\)"),
    )
    for call, place in calls:
        with pytest.raises(ConfigError, match=place):
            call()


@pytest.mark.parametrize(
    ("robots", "limit", "autoreset"), [(1, 127, "disabled"), (3, 84, "next_step")]
)
def test_waiting_world_leaves_the_memory_of_others_alone(robots, limit, autoreset):
    """At the time limit the filter of visited ground is full; one more step would overflow it."""
    how = {"n_robots": robots, "max_steps": limit, "safety_distance": 0.0, "autoreset": autoreset}
    engine = BatchEngine(FIELD, 2, **how)
    engine.reset()
    rng = np.random.default_rng(0)
    for step in range(limit):
        if step == limit - 20:
            engine.reset_worlds(np.array([False, True]))
        *_, truncated = engine.step(rng.uniform(-0.1, 0.1, (2, robots, 2)))
    assert truncated.tolist() == [True, False]
    memory = engine._backend.memory
    filters, before = memory.filter, memory.filter[1].copy()
    assert memory.words.max() <= filters.shape[1] - ODD_LINES
    active = np.array([False, True]) if autoreset == "disabled" else None
    engine.step(rng.uniform(-0.1, 0.1, (2, robots, 2)), active)
    assert 0 < np.count_nonzero(filters[1] != before) <= robots


def test_skipped_world_keeps_its_outcome():
    square = [(0, 0), (90, 0), (90, 90), (0, 90)]
    visit, still = Field(square, [(22, 20)], [(20, 20), (20, 50)]), np.zeros((2, 2, 2))
    crash = Field(square, [(80, 80)], [(20, 20), (20, 40)])
    toward = np.tile([[0.0, 1.0], [0.0, -1.0]], (2, 1, 1))
    for field, actions, success in ((visit, still, True), (crash, toward, False)):
        engine = BatchEngine(field, 2, autoreset=False, safety_distance=19.0, roi_radius=5.0)
        engine.reset()
        while engine.running[0]:
            engine.step(actions)
        before = engine.snapshot(0)
        engine.reset_worlds(np.array([False, True]))
        engine.step(still, np.array([False, True]))
        after = engine.snapshot(0)
        assert (before.success, before.collision) == (after.success, after.collision)
        assert after.success == success != after.collision
        assert before.judged().collision != success


def test_models_list_all_their_problems():
    for make, places in (
        (lambda: Uniform(True, 2), {"low"}),
        (lambda: FieldSampler(arena=("700", True), seed=True), {"arena.0", "arena.1", "seed"}),
        (lambda: RewardProfile(name=3, medium=-1, colour="red"), {"name", "medium", "colour"}),
        (lambda: NavigationConfig(tau=-1.0, colour="red"), {"tau", "colour"}),
    ):
        assert {*places_of(ConfigError, make)} == places
    assert make_config({"reward": {"name": "mine"}}).reward == RewardProfile(name="mine")
    config = make_config({"failures": {"rate": 0.1, "at": {"2": 5}, "kind": "coast"}})
    assert config.failures == Failures(rate=0.1, at={2: 5}, kind="coast")
    assert NavigationConfig(**json.loads(config.model_dump_json())) == config
    assert Settings.__annotations__.keys() == {"condition", *NavigationConfig.model_fields}


@pytest.mark.parametrize("make", [parallel_env, raw_env, centralized_env, CentralizedVecEnv])
def test_repr_names_the_class_and_the_fields(make):
    env = make(FIELD)
    assert repr(env).startswith(f"<{type(env).__name__} {FIELD}: 3 robots, 6 ROIs")
    assert repr(BatchEngine([FIELD, "field_05"], 2)).startswith("<BatchEngine field_03, field_05: ")
    assert "random fields" in repr(parallel_env(FieldSampler(robots=(2, 4))))
