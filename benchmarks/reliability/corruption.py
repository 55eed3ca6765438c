"""Damaged files, read by what reads them.

Of each file of a checkpoint, a policy and an entry of the zoo, copies with one byte changed or with
the end cut off. A copy has to be refused with a message that names it, or to be read as what was
written: a byte of the list of checksums may make no difference. Anything else is a broken promise.
"""

from __future__ import annotations

import random
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from baselines.console import console
from baselines.evaluation.policy import load_policy
from baselines.runs.files import read_json
from baselines.runs.folder import RunFolder
from baselines.training.config import TrainConfig
from baselines.training.progress_bar import Report
from baselines.training.train import train
from baselines.zoo.entries import CARD, FOLDER
from benchmarks.reliability.kills import config_of, outcome
from benchmarks.report import table
from mbn_marl.errors import MbnError


@dataclass(frozen=True)
class Subject:
    """Something that is read."""

    name: str
    folder: Path
    files: tuple[Path, ...]  # relative to the folder
    read: Callable[[Path], Any]  # from a copy of the folder; the repr of the result shows all


@dataclass
class Count:
    """The damaged copies of a subject."""

    damaged: int = 0
    refused: int = 0
    harmless: int = 0
    crashed: int = 0
    wrong: int = 0


def damaged(data: bytes, random_: random.Random) -> bytes:
    """``data`` with one byte changed, or cut off."""
    place = random_.randrange(len(data))
    if random_.random() < 0.3:
        return data[:place]
    changed = data[place] ^ random_.randrange(1, 256)
    return data[:place] + bytes([changed]) + data[place + 1 :]


def try_copies(subject: Subject, copies: int, scratch: Path, random_: random.Random) -> Count:
    """Damage copies of a subject, one file of each, and read them."""
    count, copy = Count(), scratch / "whole"
    shutil.copytree(subject.folder, copy)
    expected = repr(subject.read(copy))
    shutil.rmtree(copy)
    weights = [(subject.folder / file).stat().st_size ** 0.5 for file in subject.files]
    for number in range(copies):
        file = random_.choices(subject.files, weights)[0]
        copy = scratch / str(number)
        shutil.copytree(subject.folder, copy)
        (copy / file).write_bytes(damaged((copy / file).read_bytes(), random_))
        count.damaged += 1
        try:
            found = repr(subject.read(copy))
        except MbnError as error:
            count.refused += bool(str(error))
        except Exception as error:  # every other one is what this looks for
            print(f"{subject.name}, {file}: {type(error).__name__}: {error}", file=sys.stderr)
            count.crashed += 1
        else:
            right = found == expected
            count.harmless += right
            count.wrong += not right
            if not right:
                print(f"{subject.name}, {file}: read as something else", file=sys.stderr)
        shutil.rmtree(copy)
    return count


def subjects(folder: Path) -> Iterator[Subject]:
    """All that is damaged, made in ``folder``."""
    for family in ("decentralised", "SB3 on-policy", "SB3 off-policy"):
        config = config_of(family)
        stopped = _stopped(config, folder / f"stopped-{config.algorithm}")
        assert stopped.checkpoint is not None
        inside = _files(stopped.checkpoint)
        place = stopped.checkpoint.relative_to(stopped.path)
        parts = tuple(place / path for path in inside)

        def resume(copy: Path, config: TrainConfig = config) -> Any:
            return outcome(train(config, copy, resume=True))

        yield Subject(f"checkpoint of {config.algorithm}", stopped.path, parts, resume)
        run = train(config, folder / f"run-{config.algorithm}")
        policy = tuple(Path("policy") / path for path in _files(run.policy))
        unread = ("learner.safetensors",)  # by what evaluates
        read = tuple(path for path in policy if path.name not in unread)
        yield Subject(f"policy of {config.algorithm}", run.path, read, _read_run)
    entry = FOLDER / "field_03"
    read = tuple(path for path in _files(entry) if path.suffix != ".md")
    yield Subject("entry of the zoo", entry, read, _read_entry)


def _stopped(config: TrainConfig, out: Path) -> RunFolder:
    """A run that was interrupted after its second checkpoint."""

    def interrupt(report: Report) -> None:
        if len(RunFolder(out).evaluations) > 2:
            raise InterruptedError

    try:
        train(config, out, listener=interrupt)
    except InterruptedError:
        return RunFolder.open(out)
    raise RuntimeError("the run ended before it was interrupted")


def _files(folder: Path) -> tuple[Path, ...]:
    found = (path.relative_to(folder) for path in sorted(folder.rglob("*")) if path.is_file())
    return tuple(path for path in found if not path.name.startswith("."))


def _read_run(folder: Path) -> Any:
    """What evaluations read."""
    return outcome(RunFolder.open(folder))


def _read_entry(folder: Path) -> Any:
    """What ``mbn zoo`` and ``mbn evaluate`` read."""
    run = RunFolder.open(folder)
    policy: Any = load_policy(run)
    weights = {name: tensor.tolist() for name, tensor in policy.network.state_dict().items()}
    return run.config, run.field.to_dict(), read_json(folder / CARD), weights


@dataclass(frozen=True)
class Corruption:
    """Change one byte of files, or cut off their ends, and read them."""

    sample: int = 500
    """How many damaged copies in all."""
    seed: int = 0
    """Of the damage."""

    def run(self, command: str) -> bool:
        """Return whether every copy was refused, or read as what was written."""
        random_, counts = random.Random(self.seed), {}
        with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryDirectory() as scratch:
            made = list(subjects(Path(folder)))
            for number, subject in enumerate(made):
                copies = self.sample * (number + 1) // len(made)
                copies -= self.sample * number // len(made)
                counts[subject.name] = try_copies(subject, copies, Path(scratch), random_)
        rows = [list(vars(count).values()) for count in counts.values()]
        total = [sum(column) for column in zip(*rows, strict=True)]
        names = [*counts, "all"]
        lines = [(name, *map(str, row)) for name, row in zip(names, [*rows, total], strict=True)]
        headings = ("what", "copies", "refused", "read as written", "crashed", "read wrongly")
        console().print(table("one byte changed, or the end cut off", headings, lines))
        return not any(count.crashed or count.wrong for count in counts.values())
