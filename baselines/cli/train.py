"""``mbn train``: one policy on one field."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg


@dataclass(frozen=True)
class Train:
    """Train one policy on one field and record everything in a run folder."""

    algorithm: Positional[Annotated[str, arg(metavar="ALGO")]]
    """a2c, ppo, trpo, ars, crossq, tqc (the centralised MDP); mappo, ippo, ppo-shared and
    ppo-supersuit (decentralised)."""
    field: Positional[Annotated[str, arg(metavar="FIELD")]]
    """A name of `mbn fields`, or the path of a field file."""
    setting: Literal["A", "B", "C", "N"] = "N"
    """A: the paper's library defaults, raw observation and reward. B: its Optuna values. C: as A,
    from a policy trained on another field. N: normalised observation, scaled reward."""
    seed: int | None = None
    """Of networks, exploration and worlds; by default 33 under A, B and C, 0 under N."""
    steps: int | None = None
    """Budget in env-steps (an env-step moves every robot of one world once); by default 5,000,000
    under A, B and C, 655,360 under N."""
    num_envs: int | None = None
    """Worlds stepped side by side; by default 1 under A, B and C, the recorded number under N."""
    hyperparams: Path | None = None
    """A YAML file whose block named as the setting takes the place of the recorded one."""
    source: Annotated[Path | None, arg(name="from", metavar="RUN")] = None
    """Under C: the folder of the run whose policy it begins with; `mbn transfer` does it all."""
    device: Literal["cpu", "cuda"] = "cpu"
    """What the networks run on, and under mappo and ippo the worlds too; of the centralised ones,
    worth it for crossq and tqc."""
    evaluate_every: int = 32_768
    """Env-steps between two fresh evaluations; after each one a checkpoint is written."""
    episodes: int = 100
    """Episodes of an evaluation."""
    stop_at: float | None = None
    """Stop before the end of the budget, at the first fresh evaluation with this mean return and
    99 % success, of sampled and of mean actions."""
    set: tuple[str, ...] = ()
    """NAME=VALUE: hyperparameters, or environment.NAME=VALUE settings of the environment, instead
    of the recorded ones; a value is JSON or a word, for example entropy=0.01 model.gamma=0.9."""
    label: str | None = None
    """What tables and figures call this run, and its folder; by default the algorithm."""
    wandb: str | None = None
    """Log to this project of Weights & Biases too (pip install wandb)."""
    out: Path | None = None
    """The run folder; by default runs/ALGORITHM-SETTING-FIELD-seedSEED."""
    force: bool = False
    """If the run folder exists, move it aside (to OUT.1, OUT.2, ...)."""
    resume: bool = False
    """Go on with the interrupted run in the folder, from its newest checkpoint; the rest of the
    command must be the same."""

    def run(self, command_line: str) -> None:
        """Train, with a progress bar, and print the final evaluation."""
        from baselines.algorithms import SETTINGS
        from baselines.cli.evaluate import print_evaluations
        from baselines.training.config import TrainConfig
        from baselines.training.overrides import ENVIRONMENT, parse
        from baselines.training.progress_bar import ProgressDisplay
        from baselines.training.train import notes, train
        from mbn_marl.errors import ConfigError

        if self.force and self.resume:
            raise ConfigError("training", ["force and resume: allowed is one of them"])
        protocol, changes = SETTINGS[self.setting], parse(self.set)
        config = TrainConfig(
            self.algorithm,
            self.field,
            setting=self.setting,
            seed=protocol.seed if self.seed is None else self.seed,
            steps=protocol.steps if self.steps is None else self.steps,
            evaluate_every=self.evaluate_every,
            episodes=self.episodes,
            stop_at=self.stop_at,
            num_envs=self.num_envs,
            hyperparams=self.hyperparams,
            transferred_from=self.source,
            device=self.device,
            label=self.label,
            environment=changes.pop(ENVIRONMENT, {}),
            hyperparameters=changes,
        )
        for line in notes(config):
            print(line)
        out = self.out or Path("runs") / config.name
        with ProgressDisplay([config.name], config.steps) as display:
            run = train(
                config,
                out,
                command=command_line,
                force=self.force,
                resume=self.resume,
                wandb=self.wandb,
                listener=display,
            )
        final = run.evaluation
        print_evaluations([final["stochastic"], final["deterministic"]], title=str(run.path))
