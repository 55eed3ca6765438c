"""``mbn render``: an episode as a GIF, as a figure of its paths, or in a window."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg


@dataclass(frozen=True)
class Render:
    """Show an episode: the policy of a run, or random actions in a field."""

    source: Positional[Annotated[str, arg(metavar="RUN|FIELD")]]
    """The folder of a run, zoo:NAME (see `mbn zoo`), a name of `mbn fields`, or a field file."""
    out: Annotated[Path | None, arg(aliases=["-o"])] = None
    """A .gif for the episode, .png, .pdf or .svg for its paths; without it a window opens."""
    sampled: bool = False
    """Sample the policy's actions instead of taking their mean."""
    seed: int = 0
    """Of the world and of the sampled actions."""
    steps: int = 300
    """Stop after so many steps."""

    def run(self, command_line: str) -> None:
        """Run the episode and show it."""
        from baselines.episode import record_episode, show, write_animation, write_trajectories
        from baselines.policies import Policy, RandomPolicy, load_policy
        from baselines.zoo.entries import PREFIX, open_run
        from mbn_marl.errors import ConfigError
        from mbn_marl.field import load_field

        if self.steps < 1:
            raise ConfigError("render", [f"steps: at least 1, not {self.steps}"])
        policy: Policy = RandomPolicy(self.seed)
        if self.source.startswith(PREFIX) or Path(self.source).is_dir():
            run = open_run(self.source)
            field, settings, policy = run.field, run.config["environment"], load_policy(run)
        else:
            field, settings = load_field(self.source), {}
        snapshots = record_episode(
            policy,
            field,
            settings,
            deterministic=not self.sampled,
            seed=self.seed,
            limit=self.steps,
        )
        if self.out is None:
            show(snapshots)
        elif self.out.suffix.lower() == ".gif":
            write_animation(snapshots, self.out)
        else:
            write_trajectories(snapshots[-1], self.out)
