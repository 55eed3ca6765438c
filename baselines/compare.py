"""Train algorithms on fields with equal budgets, and compare what the runs recorded."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from baselines.episode import record_episode, write_animation, write_trajectories
from baselines.optimum import optimal_return
from baselines.parallel import Job, train_all
from baselines.policies import load_policy
from baselines.progress import Listener
from baselines.runs import RunFolder, TrainConfig, write_provenance
from baselines.statistics import RETURN_THRESHOLD
from baselines.storage import claim_folder, write_json
from baselines.table import Row, summarise, write_table
from mbn_marl.config import make_config
from mbn_marl.errors import ConfigError


@dataclass(frozen=True)
class CompareConfig:
    """What to compare: every algorithm on every field with every seed.

    Attributes:
        algorithms: names of :data:`baselines.algorithms.ALGORITHMS`.
        fields: catalogue names or paths.
        seeds: one run each.
        steps: env-steps of every run.
        evaluate_every: env-steps between two fresh evaluations.
        episodes: stochastic episodes of an evaluation.

    Raises:
        ConfigError: a list is empty or names something twice, two field files have the same name,
            or a number is out of range.
        MbnError: an algorithm or a field is not valid.
    """

    algorithms: tuple[str, ...]
    fields: tuple[str, ...]
    seeds: tuple[int, ...]
    steps: int
    evaluate_every: int
    episodes: int

    def __post_init__(self) -> None:
        """Check everything before the first run starts."""
        problems = []
        for name in ("algorithms", "fields", "seeds"):
            values = getattr(self, name)
            if not values:
                problems.append(f"{name}: at least one is needed")
            problems += [
                f"{name}: {value} is given twice"
                for value in dict.fromkeys(values)
                if values.count(value) > 1
            ]
        if problems:
            raise ConfigError("comparison", problems)
        names = [run.name for run in self.runs()]
        if len(set(names)) < len(names):
            raise ConfigError("comparison", ["fields: two files have the same name"])

    def runs(self) -> list[TrainConfig]:
        """The runs, seed by seed."""
        return [
            TrainConfig(
                algorithm,
                field,
                seed=seed,
                steps=self.steps,
                evaluate_every=self.evaluate_every,
                episodes=self.episodes,
            )
            for seed, field, algorithm in itertools.product(
                self.seeds, self.fields, self.algorithms
            )
        ]


def compare(
    config: CompareConfig,
    out: Path,
    *,
    command: str,
    processes: int,
    force: bool = False,
    listener: Listener = lambda report: None,
) -> list[Row]:
    """Train every run into a folder of its own under ``out``, then write table and figures.

    Args:
        config: what to compare.
        out: the folder of the comparison.
        command: the exact command, recorded there.
        processes: runs at a time.
        force: move a folder that is already there aside.
        listener: is told where the runs stand.

    Raises:
        RunError: ``out`` already holds something, or a run failed.
    """
    claim_folder(out, force=force)
    write_json(out / "config.json", asdict(config))
    write_provenance(out, command)
    train_all([Job(run, out / run.name) for run in config.runs()], processes, listener)
    rows = []
    for field in config.fields:
        groups = {
            algorithm: [
                RunFolder.open(out / run.name)
                for run in config.runs()
                if (run.field, run.algorithm) == (field, algorithm)
            ]
            for algorithm in config.algorithms
        }
        rows += [summarise(runs) for runs in groups.values()]
        write_figures(groups, out)
    write_table(rows, out)
    return rows


def write_figures(groups: dict[str, list[RunFolder]], out: Path) -> None:
    """Draw the learning curves of one field's runs, and an episode of the best policy."""
    from mbn_marl.render import figures

    runs = list(itertools.chain(*groups.values()))
    field = runs[0].field
    figures.learning_curves(
        {algorithm: [_curve(run) for run in group] for algorithm, group in groups.items()},
        threshold=RETURN_THRESHOLD,
        optimum=optimal_return(field, make_config(runs[0].config["environment"])),
        path=out / f"learning_curves_{field.name}.png",
    )
    best = best_run(runs)
    snapshots = record_episode(load_policy(best), field, best.config["environment"])
    last = snapshots[-1]
    title = f"{best.path.name}: return {last.team_return:,.0f}, {last.step} steps"
    write_trajectories(last, out / f"trajectories_{field.name}.png", title)
    write_animation(snapshots, out / f"episode_{field.name}.gif")


def best_run(runs: Sequence[RunFolder]) -> RunFolder:
    """The run with the best deterministic return; of equal ones the best stochastic return."""

    def rank(run: RunFolder) -> tuple[float, float]:
        final = run.evaluation
        return final["deterministic"]["return_mean"], final["stochastic"]["return_mean"]

    return max(runs, key=rank)


def _curve(run: RunFolder) -> tuple[np.ndarray, np.ndarray]:
    history = run.evaluations
    steps = np.asarray([entry["env_steps"] for entry in history])
    return steps, np.asarray([entry["return_mean"] for entry in history])
