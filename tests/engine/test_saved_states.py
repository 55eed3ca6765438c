"""A saved state that no engine has written is refused or harmless."""

import multiprocessing
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mbn_marl import BatchEngine, Failures, Uniform
from mbn_marl.errors import MbnError, ProblemsError
from tests.support.configurations import EVERYTHING, SAMPLER, STORM
from tests.support.worlds import OWN_DRAWN

STORMY = {**STORM, "n_robots": 4, "failures": Failures(rate=0.01), "action_delay": 2}
FORMAL = {
    **{**EVERYTHING, "reward": "formal", "action_noise": 0.2, "action_loss": 0.3},
    **{"gust": 0.1, "position_noise": Uniform(0.5, 1.0), "max_steps": 40, "random_starts": True},
}
CONFIGURATIONS = {
    "default": ("field_03", {"max_steps": 30}),
    "formal": ("field_03", {**FORMAL, "autoreset": "next_step"}),
    "kept plan": ("field_04", {**STORM, "assignment": True, "action_delay": 1}),
    "storm": (SAMPLER, STORMY),
    "disabled": (SAMPLER, {**STORMY, "autoreset": False}),
    "own": ("field_03", {**OWN_DRAWN, "max_steps": 40}),
}
EDITS = dict.fromkeys(CONFIGURATIONS, 1000) | {"default": 4000, "formal": 2000, "kept plan": 2000}
BAD = (0, 1, -1, -2, 2, 3, 5, 24, 31, 64, 99, 127, 255, 1000, 2**31 - 1, -(2**31), 2**40, 2**62)
REALS = (np.nan, np.inf, -np.inf, 1e30, -1e30, 1e-30, 0.5, -0.5, 1e308)


def make(name: str) -> BatchEngine:
    field, settings = CONFIGURATIONS[name]
    return BatchEngine(field, 5, seed=3, threads=1, **settings)


def put(where: Any, value: Any) -> Callable[[NDArray[Any]], None]:
    def edit(array: NDArray[Any]) -> None:
        array[where] = value

    return edit


@pytest.mark.parametrize(
    ("name", "array", "edit", "place"),
    [
        ("default", "now.steps", put(2, 10**8), r"now.steps\[2\] \(world 2\): .*0 to 30"),
        ("default", "now.steps", put(2, 30), r"now.steps: not so in world 2; .*less than 30"),
        ("default", "final.visited", put(1, 1 << 24), r"final.visited\[1\] \(world 1\)"),
        ("default", "now.x", put((1, 4), np.nan), r"now.x\[1, 4\] \(world 4\): nan; allowed: 0 to"),
        ("default", "memory.words", put(3, 2**40), r"memory.words\[3\] \(world 3\)"),
        ("storm", "memory.words", put(3, 33), r"memory.words: not so in world 3; .*powers"),
        ("default", "memory.pending", lambda a: a.view(np.uint8).fill(2), "memory.pending"),
        ("default", "memory.trail", put((2, 3, 1), np.nan), r"memory.trail\[2, 3, 1\] \(world 2\)"),
        ("default", "output.events", put((1, 3), -1), r"output.events\[1, 3\] \(world 3\)"),
        ("default", "output.rewards", put((3, 1), np.inf), r"\(world 3\): inf; .*finite numbers"),
        ("default", "seed", put(0, -1), r"seed\[0\]: -1"),
        ("formal", "memory.trail_code", put((0, 1), 1 << 20), "memory.trail_code"),
        ("formal", "now.drawn", put((0, 1), np.nan), "now.drawn"),
        ("formal", "now.heading", put((2, 1), 4.0), "now.heading"),
        ("kept plan", "memory.plan", put((1, 4), 24), r"memory.plan\[1, 4\] \(world 1\)"),
        ("kept plan", "memory.plan", put((1, slice(3, 24)), 0), r"memory.plan: not so in world 1"),
        ("own", "now.knows", put((2, 1), 1 << 6), r"now.knows\[2, 1\] \(world 1\)"),
        ("storm", "geometry.robots_in", put(4, 99), r"geometry.robots_in\[4\].*0 to 4"),
        ("storm", "geometry.ways_in", put((1, 2), 99), r"geometry.ways_in\[1, 2\] \(world 2\)"),
        ("storm", "geometry.boxes", put((2, 0), np.inf), "geometry.boxes"),
        ("storm", "now.queue", put((5, 0), 2.0), "now.queue"),
        ("storm", "now.status", put((0, 0), 3), r"now.status\[0, 0\] \(world 0\): 3; .*0 to 2"),
    ],
)
def test_values_out_of_range_are_named(name, array, edit, place):
    engine = make(name)
    saved, kept = engine.save_state(), engine.save_state()
    if array in ("now.steps", "memory.words"):
        saved["memory.pending"][:] = False
    edit(saved[array])
    one = "not so" in place  # between values in their ranges
    saved["memory.episode"][0] = -1 if one else -2
    with pytest.raises(ProblemsError, match=place) as caught:
        engine.load_state(saved)
    assert len(caught.value.problems) == 2 - one
    after = engine.save_state()
    assert all(np.array_equal(kept[one], after[one], equal_nan=True) for one in kept)


@pytest.mark.parametrize("value", [None, [1.0] * 15, 3, np.zeros(15), np.ma.masked_all((3, 5))])
def test_wrong_arrays_are_refused(value):
    engine = make("default")
    for saved in (value, {}, {**engine.save_state(), "now.x": value}):
        with pytest.raises(MbnError, match="worlds"):
            engine.load_state(saved)


@np.errstate(all="ignore")
def edited(saved: dict[str, NDArray[Any]], rng: np.random.Generator) -> dict[str, Any]:
    copies = {name: array.copy() for name, array in saved.items()}
    for _ in range(rng.integers(1, 4)):
        name = str(rng.choice(sorted(copies)))
        array = copies[name]
        flat = array.reshape(-1)
        k = rng.integers(flat.size) if rng.integers(4) else slice(None)
        kind = rng.integers(20)
        if kind == 0:
            copies[name] = array[..., :-1]
        elif kind == 1:
            copies[name] = array.astype(np.float64 if array.dtype != np.float64 else np.int64)
        elif kind == 2:
            raw = flat.view(np.uint8)
            raw[rng.integers(raw.size)] ^= np.uint8(1 << rng.integers(8))
        elif array.dtype.kind == "f" and kind < 10:
            flat[k] = array.dtype.type(rng.choice(REALS))
        elif array.dtype.kind != "b" and kind < 14:
            flat[k] += np.array(rng.choice(BAD)).astype(array.dtype)
        else:
            flat[k] = np.array(rng.choice(BAD)).astype(array.dtype)
    return copies


def fuzz(name: str, edits: int) -> None:
    engine, rng = make(name), np.random.default_rng(7)
    accepted, saved = 0, {}
    for number in range(edits):
        if number % 50 == 0:
            engine.reset(seed=number)
            for _ in range(rng.integers(1, 25)):
                step(engine)
            saved = engine.save_state()
            engine.load_state(saved)
        try:
            engine.load_state(edited(saved, rng))
            accepted += 1
            for _ in range(4):
                step(engine)
            engine.infos(), engine.state(), engine.metrics()
        except MbnError:
            continue
        engine.load_state(saved)
    assert edits // 20 < accepted < edits, accepted


def step(engine: BatchEngine) -> None:
    if engine.autoreset == "disabled":
        engine.reset_worlds(~engine.running)
    engine.step(engine.sample_actions())


@pytest.mark.all
@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_edited_states_are_refused_or_run(name):
    child = multiprocessing.get_context("spawn").Process(target=fuzz, args=(name, EDITS[name]))
    child.start()
    child.join(600)
    child.kill()
    assert child.exitcode == 0
