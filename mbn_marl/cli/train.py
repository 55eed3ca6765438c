"""``mbn train``: one policy on one field."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg


@dataclass(frozen=True)
class Train:
    """Train one policy on one field and record everything in a run folder."""

    algorithm: Positional[Annotated[str, arg(metavar="ALGO")]]
    """ppo (the centralised single MDP), mappo or ippo (decentralised)."""
    field: Positional[Annotated[str, arg(metavar="FIELD")]]
    """A name of `mbn fields`, or the path of a field file."""
    seed: int = 0
    """Of networks, exploration and worlds."""
    steps: int = 655_360
    """Budget in env-steps; an env-step moves every robot of one world once."""
    evaluate_every: int = 32_768
    """Env-steps between two fresh evaluations."""
    episodes: int = 100
    """Episodes of an evaluation."""
    out: Path | None = None
    """The run folder; by default runs/ALGORITHM-FIELD-seedSEED."""
    force: bool = False
    """If the run folder exists, move it aside (to OUT.1, OUT.2, ...)."""

    def run(self, command_line: str) -> None:
        """Train, with a progress bar, and print the final evaluation."""
        from baselines.progress import ProgressDisplay
        from baselines.runs import TrainConfig
        from baselines.train import train
        from mbn_marl.cli.evaluate import print_evaluations

        config = TrainConfig(
            self.algorithm,
            self.field,
            seed=self.seed,
            steps=self.steps,
            evaluate_every=self.evaluate_every,
            episodes=self.episodes,
        )
        out = self.out or Path("runs") / config.name
        with ProgressDisplay([config.name], config.steps) as display:
            run = train(config, out, command=command_line, force=self.force, listener=display)
        final = run.evaluation
        print_evaluations([final["stochastic"], final["deterministic"]], title=str(run.path))
