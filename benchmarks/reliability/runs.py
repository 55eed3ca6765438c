"""Trainings killed at random moments and resumed, and their files damaged and read.

Runs end with ``kill -9`` at a moment drawn uniformly from the time of a whole run, are resumed, and
compared with one that was left alone. Damaged copies of checkpoints, policies and an entry of the
zoo have to be refused with a message that names them, or to be read as what was written: a byte of
the list of checksums may make no difference.
"""

from __future__ import annotations

import csv
import io
import random
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from baselines.compare.text_table import TextTable
from baselines.evaluation.policy import load_trained
from baselines.runs.files import read_json, read_text
from baselines.runs.folder import RunFolder
from baselines.training.config import TrainConfig
from baselines.training.progress_bar import Report
from baselines.training.train import train
from baselines.zoo.entries import CARD, FOLDER
from mbn_marl.errors import ConfigError, MbnError, unknown

SMALL = {"policy_kwargs": {"net_arch": [8]}}
ON_POLICY = {**SMALL, "n_steps": 32, "batch_size": 32}
OFF_POLICY = {**SMALL, "learning_starts": 100, "batch_size": 16, "buffer_size": 300}
TEAM = {"num_worlds": 4, "rollout_steps": 16, "hidden": [8], "roi_radius": 4.0}
FAMILIES: Mapping[str, tuple[str, dict[str, Any], int]] = {
    "decentralised": ("mappo", {**TEAM, "action_repeat": [2, 1]}, 6_000),
    "SB3 on-policy": ("ppo", {"num_envs": 2, "model": ON_POLICY}, 1_500),
    "SB3 off-policy": ("tqc", {"num_envs": 2, "model": OFF_POLICY}, 500),
    "random search": ("ars", {"num_envs": 1, "model": {"n_delta": 1, "n_top": 1}}, 2_000),
    "shared": ("ppo-shared", {"num_envs": 2, "model": ON_POLICY}, 1_500),
}
"""Of each trainer an algorithm, its hyperparameters, and a budget of a second or two."""
KILLED = ("kills", "before a checkpoint", "lost", "steps wrong", "not equal")
DAMAGED = ("copies", "refused", "read as written", "crashed", "read wrongly")


def config_of(family: str) -> TrainConfig:
    """Return a run of a family, with six fresh evaluations and as many checkpoints on the way."""
    name, hyperparameters, steps = FAMILIES[family]
    return TrainConfig(
        name,
        "field_03",
        steps=steps,
        evaluate_every=steps // 7,
        episodes=2,
        environment={"max_steps": 50, "random_starts": True},
        hyperparameters=hyperparameters,
    )


def killed_after(seconds: float, config: TrainConfig, out: Path) -> bool:
    """Train in a process that is killed after ``seconds``; return whether it had not ended yet."""
    process = get_context("fork").Process(target=begin_or_resume, args=(config, out))
    process.start()
    process.join(seconds)
    process.kill()
    process.join()
    if process.exitcode is None or process.exitcode > 0:
        raise RuntimeError(f"the training in {out} failed before it was killed")
    return process.exitcode < 0


def begin_or_resume(config: TrainConfig, out: Path) -> RunFolder:
    """Run the same command again, with --resume once there is a run."""
    return train(config, out, resume=(out / "config.json").exists())


def outcome(run: RunFolder) -> dict[str, Any]:
    """Return all that a run recorded but the seconds, and its policy's parameters."""
    policy: Any = load_trained(run)
    normalization = getattr(policy, "normalization", None)
    return {
        "rows": [*map(timeless, csv.DictReader(io.StringIO(read_text(run.progress))))],
        "evaluations": [*map(timeless, run.evaluations)],
        "evaluation": timeless(run.evaluation),
        "parameters": {name: value.tolist() for name, value in policy.network.state_dict().items()},
        "normalization": None if normalization is None else normalization.to_json(),
    }


def timeless(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Return a record without its seconds."""
    return {name: value for name, value in entry.items() if "seconds" not in name}


def kill_family(family: str, kills: int, folder: Path, seed: int) -> Counter[str]:
    """Kill and resume runs of a family until so many were killed."""
    config, random_ = config_of(family), random.Random(f"{family} {seed}")
    expected = outcome(train(config, folder / "warm"))  # this one compiles, too
    started = time.perf_counter()
    train(config, folder / "whole")
    seconds = time.perf_counter() - started
    count = Counter[str]()
    while count["kills"] < kills:
        out = folder / f"run{count['kills']}"
        if not killed_after(random_.uniform(0.0, seconds), config, out):
            out.rename(folder / f"ended{random_.random()}")
            continue
        count["kills"] += 1
        count["before a checkpoint"] += not [*out.glob("checkpoints/[0-9]*"), *out.glob("policy")]
        try:
            found = outcome(begin_or_resume(config, out))
        except Exception as error:  # whatever it is, the run is lost, and the table says so
            print(f"{out}: {type(error).__name__}: {error}", file=sys.stderr)
            count["lost"] += 1
            continue
        steps = [int(row["env_steps"]) for row in found["rows"]]
        once = steps == sorted(set(steps)) and steps[-1] == found["evaluation"]["env_steps"]
        count["steps wrong"] += not once
        count["not equal"] += str(found) != str(expected)  # NaN included
    return count


def print_counts(
    title: str, kinds: Sequence[str], counts: Mapping[str, Counter[str]]
) -> Counter[str]:
    """Print the counts of each kind, and return their sums."""
    total = sum(counts.values(), Counter[str]())
    rows = {**counts, "all": total}.items()
    lines = tuple((name, *(str(count[kind]) for kind in kinds)) for name, count in rows)
    TextTable("", ("what", *kinds), lines).print(title)
    return total


@dataclass(frozen=True)
class Kills:
    """Kill trainings of every family at random moments, resume them, and compare."""

    kills: int = 20
    """Of each family."""
    families: tuple[str, ...] = tuple(FAMILIES)
    """Which ones."""
    seed: int = 0
    """Of the moments."""

    def run(self, command: str) -> bool:
        """Return whether nothing was lost, and everything is equal."""
        strange = [name for name in self.families if name not in FAMILIES]
        if strange:
            problems = [f"families: {one}: {unknown('family', one, FAMILIES)}" for one in strange]
            raise ConfigError("kills", problems)
        counts = {}
        with tempfile.TemporaryDirectory() as folder:
            for family in self.families:
                place = Path(folder) / FAMILIES[family][0]
                name = f"{family} ({place.name})"
                counts[name] = kill_family(family, self.kills, place, self.seed)
                print(f"{name}: {dict(counts[name])}", flush=True)
        total = print_counts("kill -9 at random moments, then --resume", KILLED, counts)
        return not (total["lost"] or total["steps wrong"] or total["not equal"])


@dataclass(frozen=True)
class Subject:
    """Something that is read."""

    name: str
    folder: Path
    files: tuple[Path, ...]  # relative to the folder
    read: Callable[[Path], Any]  # from a copy of the folder; the repr of the result shows all


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
    count, copy = Counter[str](), scratch / "copy"
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
        name = f"policy of {config.algorithm}"
        yield Subject(name, run.path, read, lambda copy: outcome(RunFolder.open(copy)))
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


def _read_entry(folder: Path) -> Any:
    """Read what ``mbn zoo`` and ``mbn evaluate`` read."""
    run = RunFolder.open(folder)
    policy: Any = load_trained(run)
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
        total = print_counts("one byte changed, or the end cut off", DAMAGED, counts)
        return not (total["crashed"] or total["read wrongly"])
