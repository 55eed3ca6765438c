"""``mbn train``: one policy on one field."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import arg

from baselines.cli.options import check_options
from baselines.training.config import TrainConfig
from mbn_marl.config import Condition


@dataclass(frozen=True)
class Train:
    """Train one policy on one field and record everything in a run folder."""

    config: Annotated[TrainConfig, arg(name="")]
    set: Annotated[tuple[str, ...], arg(metavar="NAME=VALUE ...")] = ()
    """Hyperparameters, or environment.NAME=VALUE for settings of the environment, that replace the
    recorded ones; a value is JSON or a word, for example entropy=0.01 model.gamma=0.9."""
    condition: Condition | None = None
    """A named condition: settings of the environment."""
    wandb: str | None = None
    """Log to this project of Weights & Biases too (pip install wandb)."""
    out: Path | None = None
    """The run folder; by default runs/ALGORITHM-SETTING-FIELD-seedSEED."""
    force: bool = False
    """If the run folder exists, move it aside (to OUT.1, OUT.2, ...)."""
    resume: bool = False
    """Resume the interrupted run in the folder from its newest checkpoint; the rest of the command
    must be the same."""

    def run(self, command_line: str) -> None:
        """Train, with a progress bar, and print the final evaluation."""
        from baselines.cli.evaluate import print_evaluations
        from baselines.training.config import ENVIRONMENT, parse
        from baselines.training.run_logger import progress_bars
        from baselines.training.train import notes, train

        wrong = {"force and resume: allowed is one of them": self.force and self.resume}
        check_options("training", wrong)
        changes = parse(self.set)
        environment = changes.pop(ENVIRONMENT, {})
        twice = self.condition is not None and "condition" in environment
        allowed = "--condition or --set environment.condition"
        check_options("training", {f"condition: is set twice; allowed: {allowed}": twice})
        if self.condition is not None:
            environment = {**environment, "condition": self.condition}
        config = replace(self.config, environment=environment, hyperparameters=changes)
        for line in notes(config):
            print(line)
        out = self.out or Path("runs") / config.name
        how: dict[str, Any] = {n: getattr(self, n) for n in ("force", "resume", "wandb")}
        with progress_bars([config.name], config.steps) as show:
            run = train(config, out, command=command_line, listener=show, **how)
        final = run.evaluation
        print_evaluations([final["stochastic"], final["deterministic"]], title=str(run.path))
