"""``mbn compare``: algorithms on fields, several seeds each, equal budgets."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Compare:
    """Train every algorithm on every field with every seed, then print and write a comparison."""

    algos: tuple[str, ...] = ("ppo", "mappo", "ippo")
    """ppo (the centralised single MDP), mappo, ippo (decentralised)."""
    fields: tuple[str, ...] = ("field_03",)
    """Names of `mbn fields`, or paths of field files."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """One run per algorithm, field and seed."""
    steps: int = 655_360
    """Budget of every run in env-steps."""
    evaluate_every: int = 32_768
    """Env-steps between two fresh evaluations."""
    episodes: int = 100
    """Episodes of an evaluation."""
    processes: int = os.cpu_count() or 1
    """Runs at a time; each takes one core."""
    out: Path = Path("runs/comparison")
    """The folder to write: table, figures, GIF, and a run folder for every run."""
    force: bool = False
    """If the folder exists, move it aside (to OUT.1, OUT.2, ...)."""

    def run(self, command_line: str) -> None:
        """Train with a bar for every run, then print the table."""
        from rich.console import Console

        from baselines.compare import CompareConfig, compare
        from baselines.progress import ProgressDisplay
        from baselines.table import print_table
        from mbn_marl.errors import ConfigError

        if self.processes < 1:
            raise ConfigError("comparison", [f"processes: at least 1, not {self.processes}"])
        config = CompareConfig(
            self.algos, self.fields, self.seeds, self.steps, self.evaluate_every, self.episodes
        )
        with ProgressDisplay([run.name for run in config.runs()], config.steps) as display:
            rows = compare(
                config,
                self.out,
                command=command_line,
                processes=self.processes,
                force=self.force,
                listener=display,
            )
        console = Console()
        print_table(rows, console)
        console.print(f"written to {self.out}: table, figures, GIF and the runs")
