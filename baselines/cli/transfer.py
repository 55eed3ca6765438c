"""``mbn transfer``: setting C, from a policy of one field to others."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg


@dataclass(frozen=True)
class Transfer:
    """Train under setting A on one field, then continue from that policy on each other field."""

    algorithm: Positional[Annotated[str, arg(metavar="ALGO")]]
    """a2c, ppo, trpo, ars, crossq or tqc."""
    fields: tuple[str, ...] = ()
    """Where to continue: names of `mbn fields` or paths; by default all others of the catalogue."""
    source: str = "field_01"
    """Where the policy comes from. A finished run of it in OUT is taken, of any budget unless
    --source-steps says which."""
    seed: int = 33
    """Of networks, exploration and worlds."""
    steps: int = 5_000_000
    """Budget of every run in env-steps."""
    source_steps: int | None = None
    """Budget of the source's run; by default the same."""
    num_envs: int | None = None
    """Worlds stepped side by side; by default 1."""
    device: Literal["cpu", "cuda"] = "cpu"
    """What the networks run on."""
    evaluate_every: int = 32_768
    """Env-steps between two fresh evaluations; after each one a checkpoint is written."""
    episodes: int = 100
    """Episodes of an evaluation."""
    processes: int = 1
    """Runs at a time; each takes one core. All others begin when the source is finished."""
    out: Path = Path("runs")
    """The folder of all runs: ALGO-A-SOURCE-seedSEED and ALGO-C-FIELD-seedSEED."""
    resume: bool = False
    """Resume interrupted runs from their newest checkpoints, and leave finished ones."""

    def run(self, command_line: str) -> None:
        """Train with a bar for every run, then print the final evaluations."""
        from baselines.cli.evaluate import print_evaluations
        from baselines.runs.folder import RunFolder
        from baselines.sweep.processes import LocalEngine
        from baselines.sweep.run import check_outcomes, train_runs
        from baselines.sweep.transfer import transfer_runs
        from baselines.training.config import TrainConfig
        from baselines.training.progress_bar import ProgressDisplay
        from mbn_marl.errors import ConfigError
        from mbn_marl.field import catalogue_names, load_field

        counts = {"processes": self.processes, "source_steps": self.source_steps}
        problems = [
            f"{name}: at least 1, not {n}" for name, n in counts.items() if n is not None and n < 1
        ]
        if problems:
            raise ConfigError("transfer", problems)
        config = TrainConfig(
            self.algorithm,
            self.source,
            setting="A",
            seed=self.seed,
            steps=self.steps,
            evaluate_every=self.evaluate_every,
            episodes=self.episodes,
            num_envs=self.num_envs,
            device=self.device,
        )
        fields = self.fields or tuple(
            name for name in catalogue_names() if load_field(name) != load_field(self.source)
        )
        runs = transfer_runs(
            config, self.out, fields, source_steps=self.source_steps, resume=self.resume
        )
        with ProgressDisplay([run.name for run in runs], self.steps) as display:
            outcomes = train_runs(
                runs, str(self.out), LocalEngine(self.processes), listener=display
            )
        source = RunFolder(self.out / config.name)
        if source.finished:
            print(f"from: {source.path}, {source.evaluation['env_steps']:,} env-steps")
        done = [RunFolder(self.out / run.name) for run in runs if run.setting == "C"]
        for folder in (source, *done):
            if folder.finished:
                final = folder.evaluation
                print_evaluations([final["stochastic"], final["deterministic"]], str(folder.path))
        check_outcomes(outcomes.values(), self.out)
