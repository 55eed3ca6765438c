"""``mbn watch`` and ``mbn play``: a policy in a window, alone or with a person."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from baselines.cli.subject import Subject


@dataclass(frozen=True, kw_only=True)
class _Window(Subject):
    """The options of both commands."""

    source: Positional[Annotated[str, arg(metavar="POLICY|FIELD")]]
    """As for `mbn evaluate`; or a field, with its policy of the zoo if there is one, else random
    actions."""
    sampled: bool = False
    """Sample the policy's actions instead of taking their mean."""
    seed: int = 0
    """Of the worlds and of sampled actions."""
    speed: float = 10.0
    """Steps a second."""
    episodes: int | None = None
    """Close the window after so many."""
    out: Path | None = None
    """Write the last episode to this .json file (see `mbn replay`)."""
    force: bool = False
    """If that file exists, move it aside."""

    def run(self, command_line: str) -> None:
        """Show episodes until the window is closed, and keep the last one if asked to."""
        from baselines.evaluation.window import Show, watch
        from baselines.policies.load import find_policy, of_zoo
        from mbn_marl.episode import save_episode
        from mbn_marl.errors import MbnError
        from mbn_marl.files import check_free, claim_file

        how: dict[str, Any] = {"seed": self.seed, "alone": of_zoo, **self.asked}
        actor = find_policy(self.source, self.field, **how)
        if self.out is not None:
            if self.out.suffix.lower() != ".json":
                raise MbnError(f"{self.out}: the file name has to end in .json")
            check_free(self.out, force=self.force)
        show = Show(not self.sampled, self.seed, self.speed, self.episodes)
        robot = self.robot if isinstance(self, Play) else None
        shown = watch(actor, show, robot)
        for episode in shown:
            print(f"{episode.outcome}, {episode.steps} steps, return {episode.team_return:,.0f}")
        if self.out is not None and shown:
            save_episode(shown[-1], claim_file(self.out, force=self.force))
            print(f"written to {self.out}")


@dataclass(frozen=True, kw_only=True)
class Watch(_Window):
    """Watch a policy in a window. Space pauses, R starts it again, Escape closes it."""


@dataclass(frozen=True, kw_only=True)
class Play(_Window):
    """Drive one robot with the arrow keys or W, A, S, D, while a policy drives the others."""

    robot: int = 0
    """Which robot is yours."""
