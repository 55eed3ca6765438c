"""``mbn tune``: hyperparameters with Optuna, in the paper's ranges."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from baselines.cli.options import CORES, OptionalOutput, Writes, check_options
from baselines.console import console
from baselines.paper.published import tuning_ranges
from baselines.training.config import TrainConfig
from mbn_marl.errors import collecting


@dataclass(frozen=True)
class Tune(Writes):
    """Tune what the paper tuned, and write the values that `mbn train --setting B` reads."""

    algorithm: Positional[Annotated[str, arg(metavar="ALGO")]]
    """a2c, ppo, trpo, ars, crossq or tqc."""
    field: str = "field_01"
    """A name of `mbn fields`, or the path of a field file."""
    trials: int = 20
    """The number of ended trials, finished or pruned; with --resume earlier ones count."""
    steps: int = 1_000_000
    """Budget of a trial in env-steps."""
    evaluate_every: int = 50_000
    """Env-steps between two fresh evaluations; after each a trial may be pruned."""
    episodes: int = 100
    """Episodes of an evaluation."""
    seed: int = 33
    """Of the sampler and of every training."""
    num_envs: int = 1
    """Worlds stepped side by side."""
    processes: int = CORES
    """local: trials at a time; each takes one core."""
    engine: Literal["local", "ray"] = "local"
    """local: processes of this machine. ray: a running cluster that sees the study's folder."""
    address: str | None = None
    """ray: HOST:PORT of the cluster; by default $RAY_ADDRESS, or the cluster of this machine."""
    out: OptionalOutput = None
    """The folder of the study; by default runs/tune-ALGO-FIELD."""
    resume: bool = False
    """Continue the study that is there; another trial replaces one that was interrupted."""

    def run(self, command_line: str) -> None:
        from optuna.trial import FrozenTrial
        from rich.progress import MofNCompleteColumn, Progress, TimeElapsedColumn

        from baselines.sweep.run import make_engine
        from baselines.tuning.tune import CONFIG, DIVERGED, ended, load_study, search_space, tune

        wrong = {
            "force and resume: allowed is one of them": self.force and self.resume,
            f"trials: at least 1, not {self.trials}": self.trials < 1,
        }
        problems: list[str] = []
        with collecting(problems):
            engine = make_engine(self.engine, self.processes, self.address)
        with collecting(problems):
            space = search_space(self.algorithm)
            config = TrainConfig(setting="A", **{name: getattr(self, name) for name in CONFIG})
        check_options("tuning", wrong, problems)
        out = self.out or Path("runs") / f"tune-{self.algorithm}-{Path(self.field).stem}"
        screen = console()
        for name in tuning_ranges(self.algorithm):
            if name not in space:
                print(f"skipped: {name}, since {self.algorithm} has no such argument")
        before = len(ended(load_study(out))) if self.resume else 0
        columns = (*Progress.get_default_columns()[:3], MofNCompleteColumn(), TimeElapsedColumn())
        with Progress(*columns, console=screen, disable=not screen.is_terminal) as bars:
            whole = bars.add_task("trials", total=self.trials, completed=before)

            def tell(trial: FrozenTrial) -> None:
                state = DIVERGED if DIVERGED in trial.user_attrs else trial.state.name.lower()
                reward = "" if trial.value is None else f", return {trial.value:,.0f}"
                values = " ".join(f"{name}={value:.4g}" for name, value in trial.params.items())
                print(f"trial {trial.number}: {state}{reward}; {values}", flush=True)
                bars.advance(whole)

            how: dict[str, Any] = {n: getattr(self, n) for n in ("trials", "resume", "force")}
            path = tune(config, out, engine=engine, command=command_line, listener=tell, **how)
        print(
            f"written to {out}: trials.csv, history.png, {path.name}. To train with it:\n"
            f"mbn train {self.algorithm} FIELD --setting B --hyperparams {path}"
        )
