"""``mbn evaluate``: fresh episodes of a trained policy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg


@dataclass(frozen=True)
class Evaluate:
    """Evaluate the policy of a run on fresh episodes, with sampled and with mean actions."""

    run_folder: Positional[Annotated[Path, arg(metavar="RUN")]]
    """The folder of a run."""
    episodes: int = 100
    """How many episodes."""
    seed: int | None = None
    """Of the episodes; by default the seed that every run's final evaluation has."""
    json: Path | None = None
    """Write every episode to this file."""

    def run(self, command_line: str) -> None:
        """Evaluate, print the summaries, and write the file if one is asked for."""
        from baselines.evaluate import EVALUATION_SEED, evaluate
        from baselines.policies import load_policy
        from baselines.runs import RunFolder
        from baselines.storage import write_json
        from mbn_marl.errors import ConfigError

        if self.episodes < 1:
            raise ConfigError("evaluation", [f"episodes: at least 1, not {self.episodes}"])
        run = RunFolder.open(self.run_folder)
        policy = load_policy(run)
        stochastic, deterministic = (
            evaluate(
                policy,
                run.field,
                run.config["environment"],
                episodes=self.episodes,
                deterministic=deterministic,
                seed=EVALUATION_SEED if self.seed is None else self.seed,
            )
            for deterministic in (False, True)
        )
        print_evaluations([stochastic.summary(), deterministic.summary()], title=str(run.path))
        if self.json is not None:
            write_json(
                self.json,
                {
                    "command": command_line,
                    "stochastic": stochastic.to_json(),
                    "deterministic": deterministic.to_json(),
                },
            )


def print_evaluations(summaries: Sequence[Mapping[str, Any]], title: str) -> None:
    """Print evaluations (as ``Evaluation.summary()`` has them) as a table, one a row."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title)
    for heading in ("actions", "episodes", "return", "min", "max", "success", "makespan"):
        table.add_column(heading, justify="left" if heading == "actions" else "right")
    for summary in summaries:
        makespan = summary["makespan"]
        table.add_row(
            "mean" if summary["deterministic"] else "sampled",
            str(summary["episodes"]),
            *(f"{summary[f'return_{name}']:,.0f}" for name in ("mean", "min", "max")),
            f"{summary['success_rate']:.1%}",
            "-" if makespan is None else f"{makespan:.1f}",
        )
    Console().print(table)
