"""Trainings killed at random moments, and resumed.

Each run is trained in a process of its own, ended with ``kill -9`` at a moment drawn uniformly from
the time that a whole run takes, resumed to its end, and compared with one that was left alone.
"""

from __future__ import annotations

import csv
import io
import os
import random
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from baselines.compare.text_table import TextTable
from baselines.evaluation.policy import load_policy
from baselines.runs.files import read_text
from baselines.runs.folder import RunFolder
from baselines.training.config import TrainConfig
from baselines.training.train import train

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
COUNTED = ("kills", "before a checkpoint", "lost", "steps wrong", "not equal")


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
    child = os.fork()
    if child == 0:
        code = 1
        try:
            begin_or_resume(config, out)
            code = 0
        finally:
            os._exit(code)
    time.sleep(seconds)
    os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    if os.WIFEXITED(status) and os.WEXITSTATUS(status) != 0:
        raise RuntimeError(f"the training in {out} failed before it was killed")
    return os.WIFSIGNALED(status)


def begin_or_resume(config: TrainConfig, out: Path) -> RunFolder:
    """Run the same command again, with --resume once there is a run."""
    return train(config, out, resume=(out / "config.json").exists())


def outcome(run: RunFolder) -> dict[str, Any]:
    """Return all that a run recorded but the seconds, and its policy's parameters."""
    policy: Any = load_policy(run)
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
    count = Counter(dict.fromkeys(COUNTED, 0))
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
        lines, total = [], Counter[str]()
        with tempfile.TemporaryDirectory() as folder:
            for family in self.families:
                place = Path(folder) / FAMILIES[family][0]
                count = kill_family(family, self.kills, place, self.seed)
                print(f"{family}: {dict(count)}", flush=True)
                lines.append((f"{family} ({place.name})", *map(str, count.values())))
                total += count
        table = TextTable("", ("family", *COUNTED), tuple(lines))
        table.print("kill -9 at random moments, then --resume")
        return not (total["lost"] or total["steps wrong"] or total["not equal"])
