"""``mbn train`` and ``mbn transfer``."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from baselines.cli.evaluate import print_evaluations
from baselines.cli.options import CORES, OptionalOutput, Output, Writes, check_options
from baselines.runs.files import RunError
from baselines.runs.folder import RunFolder
from baselines.training.config import ENVIRONMENT, TrainConfig, parse, validate
from mbn_marl.config import Condition
from mbn_marl.field import catalogue_names, load_field


@dataclass(frozen=True)
class Train(Writes):
    """Train one policy on one field and record everything in a run folder."""

    config: Annotated[TrainConfig, arg(name="")]
    set: Annotated[tuple[str, ...], arg(metavar="NAME=VALUE ...")] = ()
    """Hyperparameters, or environment.NAME=VALUE for settings, as JSON or words: entropy=0.01."""
    condition: Condition | None = None
    """A named condition: settings of the environment."""
    wandb: str | None = None
    """Log to this project of Weights & Biases too (pip install wandb)."""
    out: OptionalOutput = None
    """The run folder; by default runs/ALGORITHM-SETTING-FIELD-seedSEED. Algorithms without setting
    A omit N; a label replaces ALGORITHM-SETTING."""
    resume: bool = False
    """Resume the interrupted run from its newest checkpoint, with the same command otherwise."""

    def run(self, command_line: str) -> None:
        from baselines.training.run_logger import progress_bars
        from baselines.training.train import notes, train

        changes = parse(self.set)
        environment = changes.pop(ENVIRONMENT, {})
        wrong = {
            "force and resume: allowed is one of them": self.force and self.resume,
            "condition: is set twice; allowed: --condition or --set environment.condition": (
                self.condition is not None and "condition" in environment
            ),
        }
        check_options("training", wrong)
        if self.condition is not None:
            environment = {**environment, "condition": self.condition}
        config = replace(self.config, environment=environment, hyperparameters=changes)
        for line in notes(config):
            print(line)
        out = self.out or Path("runs") / config.name
        how: dict[str, Any] = {n: getattr(self, n) for n in ("force", "resume", "wandb")}
        with progress_bars([config]) as show:
            run = train(config, out, command=command_line, listener=show, **how)
        final = run.evaluation
        print_evaluations([final["stochastic"], final["deterministic"]], title=str(run.path))


@dataclass(frozen=True)
class Transfer:
    """Train under setting A on one field, then continue from that policy on each other field."""

    algorithm: Positional[Annotated[str, arg(metavar="ALGO")]]
    """a2c, ppo, trpo, ars, crossq or tqc."""
    fields: tuple[str, ...] = ()
    """Those to continue on: names of `mbn fields` or paths; by default all of the catalogue."""
    source: str = "field_01"
    """The field of the policy; a finished run of it in OUT is taken, if --source-steps allows."""
    seed: int = 33
    """Of networks, exploration and worlds."""
    steps: int = 5_000_000
    """Budget of every run in env-steps."""
    source_steps: int | None = None
    """Budget of the source's run; by default the same."""
    num_envs: int | None = None
    """Worlds stepped side by side; by default 1."""
    evaluate_every: int = 32_768
    """Env-steps between two fresh evaluations; after each one a checkpoint is written."""
    episodes: int = 100
    """Episodes of an evaluation."""
    processes: int = CORES
    """Runs at a time; each takes one core. All others begin when the source is finished."""
    out: Output = Path("runs")
    """The folder of all runs: ALGO-A-SOURCE-seedSEED and ALGO-C-FIELD-seedSEED."""
    resume: bool = False
    """Resume interrupted runs from their newest checkpoints, and leave finished ones."""

    def run(self, command_line: str) -> None:
        from baselines.sweep.processes import LocalEngine
        from baselines.sweep.run import check_outcomes, train_runs
        from baselines.sweep.spec import GridSpec, runs_of
        from baselines.training.run_logger import progress_bars

        home, engine = load_field(self.source), LocalEngine(self.processes)
        others = [name for name in catalogue_names() if load_field(name) != home]
        wrong: dict[str, object] = {
            f"fields: {field} is the field that the policy comes from": load_field(field) == home
            for field in self.fields
        }
        few = self.source_steps is not None and self.source_steps < 1
        wrong[f"source_steps: at least 1, not {self.source_steps}"] = few
        check_options("transfer", wrong)
        spec = {
            "store": str(self.out),
            "algorithms": (self.algorithm,),
            "fields": self.fields or others,
            "settings": ("C",),
            "seeds": (self.seed,),
            "source": self.source,
            "budget": {n: getattr(self, n) for n in ("steps", "evaluate_every", "episodes")},
        }
        first, *targets = (
            replace(run, num_envs=self.num_envs)
            for run in runs_of(validate(GridSpec, spec, "transfer"))
        )
        source, runs = RunFolder(self.out / first.name), targets
        if not source.finished:
            runs = [replace(first, steps=self.source_steps or self.steps), *targets]
        elif self.source_steps not in (None, steps := source.config["steps"]):
            raise RunError(
                f"{source.path} is finished with a budget of {steps:,} env-steps, not "
                f"{self.source_steps:,}; choose another --out, or leave --source-steps out"
            )
        there = [str(self.out / run.name) for run in runs if (self.out / run.name).exists()]
        if there and not self.resume:
            problem = "already exists; choose another --out, or pass --resume"
            raise RunError(f"{', '.join(there)} {problem}")
        with progress_bars(runs) as show:
            outcomes = train_runs(runs, self.out, engine, listener=show)
        if source.finished:
            print(f"from: {source.path}, {source.evaluation['env_steps']:,} env-steps")
        for folder in (source, *(RunFolder(self.out / run.name) for run in targets)):
            if folder.finished:
                final = folder.evaluation
                print_evaluations([final["stochastic"], final["deterministic"]], str(folder.path))
        check_outcomes(outcomes.values(), self.out)
