"""Bitwise determinism over many steps and resets, batches, threads and instances."""

import copy
import multiprocessing
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray

from mbn_marl import BatchEngine, Failures, Uniform, centralized_env, parallel_env
from mbn_marl.errors import ConfigError, StepError
from tests.support.configurations import EVERYTHING, SAMPLER, STORM
from tests.support.worlds import OWN_DRAWN

pytestmark = pytest.mark.slow
STEPS = 1000
SETTINGS = {"random_starts": True, "max_steps": 90, "wind": (0.05, 40.0)}
N = 3
DISTURBED = {
    **EVERYTHING,
    **{"gust": 0.1, "action_noise": 0.2, "action_loss": 0.3, "action_delay": 2},
    **{"position_noise": Uniform(0.5, 1.0), "velocity_noise": 0.1, "dropout": 0.2},
    **{"dynamics": "mixed", "mass": Uniform(0.8, 1.5), "tau": Uniform(0.8, 1.2)},
    "failures": Failures(rate=0.002, between=(5, 40)),
}  # Every random number of the engine, for robots of every kind


def as_bytes(value: Any) -> bytes:
    if isinstance(value, dict):
        value = tuple(value.values())
    if isinstance(value, tuple | list):
        return b"".join(map(as_bytes, value))
    return np.asarray(value).tobytes()


class Runner:
    """Steps an environment or five worlds, which restart; every result as bytes."""

    def __init__(self, make: Callable[..., Any]) -> None:
        worlds = (5,) if make is BatchEngine else ()
        self.env = make("field_03", *worlds, **SETTINGS)
        self.resets = 0

    def reset(self, seed: int | None = None) -> bytes:
        self.resets += 1
        return as_bytes(self.env.reset(seed=seed)) + self._state()

    def step(self, actions: NDArray[np.float32]) -> bytes:
        if isinstance(self.env, BatchEngine):
            results = self.env.step(self.env.sample_actions() + actions)
            self.resets += int(np.count_nonzero(results[2] | results[3]))
            return as_bytes((*results, self.env.metrics())) + self._state()
        parallel = hasattr(self.env, "agents")
        named = dict(zip(self.env.agents, actions, strict=True)) if parallel else actions
        results = self.env.step(named)
        told = as_bytes(results) + self._state()
        over = not self.env.agents if parallel else results[2] or results[3]
        return told + self.reset() if over else told

    def _state(self) -> bytes:
        return as_bytes(self.env.state()) if hasattr(self.env, "state") else b""


@pytest.mark.parametrize("make", [parallel_env, centralized_env, BatchEngine])
def test_interleaved_instances_and_copies_agree_bitwise(make):
    rng = np.random.default_rng(0)
    first, second, stranger = (Runner(make) for _ in range(3))
    stranger.reset(seed=8)
    second.reset(seed=5)  # a used instance is as good as a new one
    second.step(np.zeros((N, 2), np.float32))
    assert first.reset(seed=7) == second.reset(seed=7)
    for t in range(STEPS):
        actions = rng.uniform(-1.0, 1.0, (N, 2)).astype(np.float32)
        result = first.step(actions)
        stranger.step(actions[::-1])
        assert second.step(actions) == result, f"step {t}"
        if t == 50:
            second = copy.deepcopy(first)
    assert first.resets >= STEPS // 90
    episodes = {first.reset(seed=1), first.reset(), second.reset(seed=2), second.reset()}
    assert len(episodes) == 4
    assert first.reset(seed=2) in episodes
    assert first.reset() in episodes


@pytest.mark.parametrize(
    ("source", "settings"),
    [
        ("field_03", {"autoreset": "next_step", **SETTINGS}),
        ("field_03", {"reward": "formal", **DISTURBED, **SETTINGS}),
        (SAMPLER, {"autoreset": False, **STORM, "max_steps": 12}),
        ("field_03", {**OWN_DRAWN, "max_steps": 40}),
    ],
    ids=["plain", "disturbed", "sampler", "own"],
)
def test_engine_continues_from_saved_arrays(source, settings, tmp_path):
    def make(seed: int) -> BatchEngine:
        return BatchEngine(source, 4, seed=seed, **settings)

    def go_on(engine: BatchEngine, steps: int) -> list[bytes]:
        rows = []
        for _ in range(steps):
            result = engine.step(engine.sample_actions())
            rows += [array.tobytes() for array in result]
            rows += [engine.state().tobytes(), engine.metrics()["episode_return"].tobytes()]
            if engine.autoreset == "disabled":
                engine.reset_worlds(result[2] | result[3])
            rows += [engine.field_of(3).vertices.tobytes()]
        return rows

    original = make(5)
    original.reset()
    go_on(original, 50)
    np.savez(tmp_path / "worlds.npz", allow_pickle=False, **original.save_state())
    expected = go_on(original, 120)
    other = make(6)
    with np.load(tmp_path / "worlds.npz", allow_pickle=False) as arrays:
        other.load_state(arrays)
    assert go_on(other, 120) == expected


def test_loaded_worlds_wait_for_a_reset_as_saved():
    saved = BatchEngine("field_03", 2).save_state()  # never reset
    other = BatchEngine("field_03", 2)
    other.reset()
    other.load_state(saved)
    with pytest.raises(StepError, match="world 0 was never reset"):
        other.step(np.zeros((2, N, 2)))


CASES = {
    "released": {"field": "field_01"},
    "formal": {"field": "field_07", "reward": "formal"},
    "several fields": {"field": ["field_03", "field_05", "field_10"], "autoreset": "next_step"},
    "lidar": {"field": ["field_06", "field_09"], "observation": "lidar"},
    "disturbed": {"field": "field_03", **DISTURBED},
    "storm": {"field": "field_04", **STORM},
    "own": {"field": "field_03", **OWN_DRAWN},
    "float64": {"field": "field_01", "dtype": "float64", "reward_sharing": "team"},
}
LIVELY = {"max_steps": 50, "safety_distance": 20.0, "random_starts": True, "wind": (0.05, 40.0)}


def trajectory(case: str, **batch: Any) -> list[NDArray[Any]]:
    """Everything that an engine which moves at random hands out, step by step."""
    engine = BatchEngine(seed=11, **(CASES[case] | LIVELY | batch))
    rows = [engine.reset().copy()]
    for _ in range(80):
        results = engine.step(engine.sample_actions())
        arrays = (*results, engine.team_rewards, engine.state(), engine.infos())
        rows += [array.copy() for array in arrays]
    return rows


@pytest.mark.parametrize("case", CASES)
def test_world_depends_on_neither_batch_nor_block_nor_threads(case):
    expected = trajectory(case, num_worlds=600, threads=1)
    assert sum(int(flags.sum()) for flags in expected if flags.dtype == np.bool_) > 300
    # The blocks of 256 worlds lie elsewhere in a batch that begins with another world.
    batches = [(0, 600, 2)] * 3 + [(0, 600, 5), (0, 1100, None), (198, 300, 1), (252, 9, 4)]
    for first, worlds, threads in [*batches, (6, 3, 7)]:
        rows = trajectory(case, num_worlds=worlds, threads=threads, first_world=first)
        for row, (got, wanted) in enumerate(zip(rows, expected, strict=True)):
            same = got[:600].tobytes() == wanted[first : first + worlds].tobytes()
            assert same, (first, worlds, threads, row)


def _rewards_of_threads(worlds: int) -> list[float]:
    engine = BatchEngine("field_03", worlds, threads=2)
    engine.reset(seed=0)
    return engine.step(engine.sample_actions())[1].sum(axis=1).tolist()


def test_forked_children_of_threads_step():
    expected = _rewards_of_threads(4)
    with multiprocessing.get_context("fork").Pool(1) as pool:
        assert pool.apply_async(_rewards_of_threads, (4,)).get(timeout=60) == expected


def test_threads_take_actions_that_cannot_be_written():
    free, kept = (BatchEngine("field_01", 600, threads=2) for _ in range(2))
    free.reset(), kept.reset()
    for can in (True, False, True):
        actions = free.sample_actions().copy()
        expected = free.step(actions)
        actions.flags.writeable = can
        for one, other in zip(kept.step(actions), expected, strict=True):
            np.testing.assert_array_equal(one, other)


def test_seed_and_number_decide_an_episode():
    engine = BatchEngine("field_03", 3, **SETTINGS)
    starts = [engine.reset(seed=9).copy(), engine.reset().copy(), engine.reset().copy()]
    assert engine.reset(seed=9, episode=2).tobytes() == starts[2].tobytes()
    assert engine.episode_numbers.tolist() == [2, 2, 2]
    with pytest.raises(ConfigError, match="episode"):
        engine.reset(episode=2)
    with pytest.raises(ConfigError, match="episode"):
        engine.reset(seed=1, episode=-1)


def test_random_starts_are_in_the_field_and_apart():
    engine = BatchEngine("field_05", 500, dtype="float64", **SETTINGS)
    polygon = engine.field.polygon
    engine.reset()
    states = engine.state()
    assert len({state.tobytes() for state in states}) == 500
    spots = states[:, : 2 * N].reshape(-1, N, 2)
    assert polygon.covers(shapely.MultiPoint(spots.reshape(-1, 2)))
    distances = np.linalg.norm(spots[:, :, None] - spots[:, None, :], axis=-1)
    assert distances[:, *np.triu_indices(N, 1)].min() >= 10.0
    assert (states[:, 2 * N :] == 0).all()
    low_x, low_y, high_x, high_y = polygon.bounds
    reach = np.ptp(spots.reshape(-1, 2), axis=0)
    assert (reach > 0.9 * np.array([high_x - low_x, high_y - low_y])).all()
