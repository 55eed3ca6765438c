"""``mbn transfer``: setting C, from a policy of one field to others."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg


@dataclass(frozen=True)
class Transfer:
    """Train under setting A on one field, then go on from that policy on each other field."""

    algorithm: Positional[Annotated[str, arg(metavar="ALGO")]]
    """a2c, ppo, trpo, ars, crossq or tqc."""
    fields: tuple[str, ...] = ()
    """Where to go on: names of `mbn fields` or paths; by default all others of the catalogue."""
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
    """Fine-tuning runs at a time; each takes one core."""
    out: Path = Path("runs")
    """The folder of all runs: ALGO-A-SOURCE-seedSEED and ALGO-C-FIELD-seedSEED."""
    resume: bool = False
    """Go on with interrupted runs from their newest checkpoints, and leave finished ones."""
    trust: bool = False
    """Load pickled files of runs even if you did not make them; they can run any code."""

    def run(self, command_line: str) -> None:
        """Train with a bar for every run, then print the final evaluations."""
        from dataclasses import replace

        from baselines.cli.evaluate import print_evaluations
        from baselines.runs.files import RunError
        from baselines.runs.folder import RunFolder
        from baselines.sweep.processes import train_all
        from baselines.sweep.transfer import check_sizes, find_source, transfer_jobs, transfer_runs
        from baselines.training.config import TrainConfig
        from baselines.training.progress_bar import ProgressDisplay
        from mbn_marl.errors import ConfigError
        from mbn_marl.field import catalogue_names, load_field

        any_steps = self.source_steps is None
        source_steps = self.steps if self.source_steps is None else self.source_steps
        counts = {"processes": self.processes, "source_steps": source_steps}
        problems = [f"{name}: at least 1, not {n}" for name, n in counts.items() if n < 1]
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
        runs = transfer_runs(config, self.out / config.name, fields)
        check_sizes(self.source, fields)
        jobs = transfer_jobs(runs, self.out, resume=self.resume, trust=self.trust)
        first = replace(config, steps=source_steps)
        with ProgressDisplay([first.name], first.steps) as display:
            source = find_source(
                first,
                self.out,
                any_steps=any_steps,
                resume=self.resume,
                listener=display,
                trust=self.trust,
            )
        print(f"from: {source.path}, {source.evaluation['env_steps']:,} env-steps")
        with ProgressDisplay([run.name for run in runs], self.steps) as display:
            broken = train_all(jobs, self.processes, display)
        finished = [RunFolder.open(job.out) for job in jobs if job.config.name not in broken]
        for folder in (source, *finished):
            final = folder.evaluation
            print_evaluations([final["stochastic"], final["deterministic"]], str(folder.path))
        if broken:
            raise RunError("\n".join(broken.values()))
