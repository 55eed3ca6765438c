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
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from baselines.compare.text_table import TextTable
from baselines.evaluation.policy import load_policy
from baselines.runs.files import read_json
from baselines.runs.folder import RunFolder
from baselines.training.config import TrainConfig
from baselines.training.progress_bar import Report
from baselines.training.train import train
from baselines.zoo.entries import CARD, FOLDER
from benchmarks.reliability.kills import config_of, outcome
from mbn_marl.errors import MbnError


@dataclass(frozen=True)
class Subject:
    """Something that is read."""

    name: str
    folder: Path
    files: tuple[Path, ...]  # relative to the folder
    read: Callable[[Path], Any]  # from a copy of the folder; the repr of the result shows all


COUNTED = ("copies", "refused", "read as written", "crashed", "read wrongly")


def damaged(data: bytes, random_: random.Random) -> bytes:
    """Return ``data`` with one byte changed, or cut off."""
    place = random_.randrange(len(data))
    if random_.random() < 0.3:
        return data[:place]
    changed = data[place] ^ random_.randrange(1, 256)
    return data[:place] + bytes([changed]) + data[place + 1 :]


def try_copies(
    subject: Subject, copies: int, scratch: Path, random_: random.Random
) -> Counter[str]:
    """Damage copies of a subject, one file of each, and read them."""
    count, copy = Counter(dict.fromkeys(COUNTED, 0)), scratch / "copy"
    shutil.copytree(subject.folder, copy)
    expected = repr(subject.read(copy))
    weights = [(subject.folder / file).stat().st_size ** 0.5 for file in subject.files]
    for _ in range(copies):
        file = random_.choices(subject.files, weights)[0]
        shutil.rmtree(copy)
        shutil.copytree(subject.folder, copy)
        (copy / file).write_bytes(damaged((copy / file).read_bytes(), random_))
        count["copies"] += 1
        try:
            found = repr(subject.read(copy))
        except MbnError as error:
            count["refused"] += bool(str(error))
        except Exception as error:  # every other one is what this looks for
            print(f"{subject.name}, {file}: {type(error).__name__}: {error}", file=sys.stderr)
            count["crashed"] += 1
        else:
            count["read as written" if found == expected else "read wrongly"] += 1
            if found != expected:
                print(f"{subject.name}, {file}: read as something else", file=sys.stderr)
    shutil.rmtree(copy)
    return count


def subjects(folder: Path) -> Iterator[Subject]:
    """Yield all that is damaged, made in ``folder``."""
    for family in ("decentralised", "SB3 on-policy", "SB3 off-policy"):
        config = config_of(family)
        stopped = _stopped(config, folder / f"stopped-{config.algorithm}")
        assert stopped.checkpoint is not None
        parts = _files(stopped.path, stopped.checkpoint)

        def resume(copy: Path, config: TrainConfig = config) -> Any:
            return outcome(train(config, copy, resume=True))

        yield Subject(f"checkpoint of {config.algorithm}", stopped.path, parts, resume)
        run = train(config, folder / f"run-{config.algorithm}")
        policy = _files(run.path, run.policy)  # but for what evaluations do not read
        read = tuple(path for path in policy if path.name != "learner.safetensors")
        yield Subject(f"policy of {config.algorithm}", run.path, read, _read_run)
    entry = FOLDER / "field_03"
    read = tuple(path for path in _files(entry, entry) if path.suffix != ".md")
    yield Subject("entry of the zoo", entry, read, _read_entry)


def _stopped(config: TrainConfig, out: Path) -> RunFolder:
    """Return a run that was interrupted after its second checkpoint."""

    def interrupt(report: Report) -> None:
        if len(RunFolder(out).evaluations) > 2:
            raise InterruptedError

    try:
        train(config, out, listener=interrupt)
    except InterruptedError:
        return RunFolder.open(out)
    raise RuntimeError("the run ended before it was interrupted")


def _files(root: Path, folder: Path) -> tuple[Path, ...]:
    """Return the files in a folder, relative to ``root``."""
    found = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return tuple(path.relative_to(root) for path in found if not path.name.startswith("."))


def _read_run(folder: Path) -> Any:
    return outcome(RunFolder.open(folder))


def _read_entry(folder: Path) -> Any:
    """Read what ``mbn zoo`` and ``mbn evaluate`` read."""
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
            cuts = [self.sample * number // len(made) for number in range(len(made) + 1)]
            for subject, (low, high) in zip(made, pairwise(cuts), strict=True):
                counts[subject.name] = try_copies(subject, high - low, Path(scratch), random_)
        total = sum(counts.values(), Counter())
        lines = [
            (name, *(str(count[key]) for key in COUNTED))
            for name, count in {**counts, "all": total}.items()
        ]
        table = TextTable("", ("what", *COUNTED), tuple(lines))
        table.print("one byte changed, or the end cut off")
        return not (total["crashed"] or total["read wrongly"])
