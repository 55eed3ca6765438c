"""``mbn tune``: hyperparameters with Optuna, in the paper's ranges."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from baselines.cli.options import CORES, OptionalOutput, check_options


@dataclass(frozen=True)
class Tune:
    """Tune what the paper tuned, and write the values that `mbn train --setting B` reads."""

    algorithm: Positional[Annotated[str, arg(metavar="ALGO")]]
    """a2c, ppo, trpo, ars, crossq or tqc."""
    field: str = "field_01"
    """A name of `mbn fields`, or the path of a field file."""
    trials: int = 20
    """How many trials end, finished or pruned; with --resume those from before count."""
    steps: int = 1_000_000
    """Budget of a trial in env-steps."""
    evaluate_every: int = 50_000
    """Env-steps between two fresh evaluations; after each a trial whose best one so far is below
    the median of the finished trials' is pruned."""
    episodes: int = 100
    """Episodes of an evaluation."""
    seed: int = 33
    """Of the sampler and of every training."""
    num_envs: int = 1
    """Worlds stepped side by side."""
    processes: int = CORES
    """local: trials at a time; each takes one core."""
    database: str | None = None
    """The URL of a database that keeps the trials, such as postgresql://HOST/NAME or
    sqlite:///FILE; by default they are in a journal in the folder of the study."""
    engine: Literal["local", "ray"] = "local"
    """local: processes of this machine. ray: a Ray cluster that is there already; its machines
    have to see the database, or else the folder."""
    address: str | None = None
    """ray: HOST:PORT of the cluster; by default $RAY_ADDRESS, or the cluster this machine is in."""
    out: OptionalOutput = None
    """The folder of the study; by default runs/tune-ALGO-FIELD."""
    resume: bool = False
    """Continue the study that is there; a trial that was interrupted is run again."""
    force: bool = False
    """If the folder exists, move it aside (to OUT.1, OUT.2, ...)."""

    def run(self, command_line: str) -> None:
        """Tune, with a progress bar, and say how to train with the result."""
        from baselines.console import console
        from baselines.sweep.run import make_engine
        from baselines.tuning.display import tune_display
        from baselines.tuning.study import ended, open_study
        from baselines.tuning.trial import Space, TuneConfig
        from baselines.tuning.tune import tune

        wrong = {"force and resume: allowed is one of them": self.force and self.resume}
        check_options("tuning", wrong)
        engine = make_engine(self.engine, self.processes, self.address)
        config = TuneConfig(**{one.name: getattr(self, one.name) for one in fields(TuneConfig)})
        out = self.out or Path("runs") / f"tune-{self.algorithm}-{Path(self.field).stem}"
        screen = console()
        for name in Space.of(self.algorithm).skipped:
            screen.print(f"skipped: {name}, since {self.algorithm} has no such argument")
        before = len(ended(open_study(out))) if self.resume else 0
        names = ("trials", "database", "resume", "force")
        how: dict[str, Any] = {name: getattr(self, name) for name in names}
        with tune_display(self.trials, before, self.steps, screen) as show:
            path = tune(config, out, engine=engine, command=command_line, listener=show, **how)
        screen.print(
            f"written to {out}: trials.csv, study.png, {path.name}. To train with it:\n"
            f"mbn train {self.algorithm} FIELD --setting B --hyperparams {path}",
            soft_wrap=True,
            highlight=False,
        )
