"""The measurements of docs/reliability.md, in small."""

from __future__ import annotations

import json
import mmap
import re
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
from hypothesis import strategies as st

from baselines.runs.files import read_json, seal, write_json
from baselines.training.train import prepare
from benchmarks.reliability import endurance, runs
from benchmarks.reliability import fuzz as fuzzing
from benchmarks.speed.timing import cpu_backend
from mbn_marl import BatchEngine
from mbn_marl.errors import ConfigError, MbnError
from tests.support.runs import small_config


def test_damaged_copies_are_counted(tmp_path: Path) -> None:
    folder, scratch = tmp_path / "subject", tmp_path / "scratch"
    for place in (folder, scratch):
        place.mkdir()
    for number in range(3):
        write_json(folder / f"{number}.json", {"number": number})
    seal(folder)
    files = tuple(Path(f"{number}.json") for number in range(3))
    subject = runs.Subject("sealed", folder, files, partial(_read_all, files))
    count = runs.try_copies(subject, 20, scratch, Random(0))
    assert count == Counter(copies=20, refused=20)
    unchecked = replace(subject, read=lambda copy: [(copy / file).read_bytes() for file in files])
    assert runs.try_copies(unchecked, 5, scratch, Random(0))["read wrongly"] == 5
    careless = replace(subject, read=lambda copy: [_careless(copy / file) for file in files])
    assert runs.try_copies(careless, 20, scratch, Random(0))["crashed"] > 0


def test_names_of_targets_and_families_are_checked() -> None:
    for measure in (fuzzing.Fuzz(only=("settings", "typo")), runs.Kills(families=("typo",))):
        with pytest.raises(ConfigError, match="typo"):
            measure.run("")


def _read_all(files: tuple[Path, ...], folder: Path) -> list[object]:
    return [read_json(folder / file) for file in files]


def _careless(path: Path) -> object:
    """A reader that raises whatever a damaged file causes."""
    return json.loads(path.read_bytes())["number"]


@pytest.fixture(scope="module")
def guard(tmp_path_factory: pytest.TempPathFactory) -> fuzzing.Guard:
    return fuzzing.Guard(tmp_path_factory.getbasetemp(), Path(tempfile.gettempdir(), "numba"))


@pytest.mark.parametrize(
    ("name", "inputs"), [("field reader", 150), ("episode reader", 60), ("settings", 60)]
)
def test_inputs_that_nobody_meant(
    name: str,
    inputs: int,
    guard: fuzzing.Guard,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    prepare(small_config("mappo"))  # loads the libraries
    prepare(small_config("ppo"))
    count = fuzzing.fuzz(fuzzing.targets()[name], inputs, guard, seed=0)
    assert count.broken == [] and count.inputs >= inputs and count.refused > inputs / 3


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda number: 1 // (number // 5), "ZeroDivisionError"),
        (lambda number: Path("../outside").write_text("x"), "open /.*outside"),
        (lambda number: sum(range(10**8)), r"\d\.\d s"),
    ],
    ids=["another error", "a file outside", "a hang"],
)
def test_a_broken_promise_is_noted(
    call: Callable[[int], object],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "in").mkdir()
    monkeypatch.chdir(tmp_path / "in")
    monkeypatch.setattr(fuzzing, "LONGEST", 0.2)
    guard = fuzzing.Guard(tmp_path / "in")
    target = fuzzing.Target(lambda n: call(n) and None, st.integers(0, 9), MbnError, 1.0)
    count = fuzzing.fuzz(target, 5, guard, seed=0)
    assert len(count.broken) == 1 and re.search(message, count.broken[0])


def test_invariants_of_worlds() -> None:
    engine = BatchEngine(["field_01", "field_03"], 4, seed=0, random_starts=True)
    engine.reset()
    for _ in range(50):
        engine.step(engine.sample_actions())
    assert endurance.problems(engine, [0, 1, 2, 3]) == []
    now = cpu_backend(engine).now
    now.x[0, 1] += 400.0
    now.vy[0, 2] = np.float32(5.5)
    now.team_return[3] = np.nan
    found = endurance.problems(engine, [0, 1, 2, 3])
    assert {"the trail ends here, world 1", "speed limit, world 2", "episode_return"} <= {*found}
    assert not [problem for problem in found if problem.endswith("world 0")]


def test_growth_of_memory_is_found(capsys: pytest.CaptureFixture[str]) -> None:
    kept: list[mmap.mmap] = []

    def leak(*arguments: Any) -> list[str]:
        kept.append(mmap.mmap(-1, 1 << 16))  # not from memory that the process has free
        kept[-1].write(bytes(1 << 16))
        return []

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(endurance, "problems", leak)
        assert not endurance.Endurance(env_steps=1 << 14, worlds=16).run("")
    assert "nothing" in capsys.readouterr().out
