"""``mbn render``: an episode as JSON, GIF or video, or as a figure of its paths."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

from baselines.cli.options import check_options
from baselines.cli.subject import Subject

if TYPE_CHECKING:
    from mbn_marl.episode import Episode


@dataclass(frozen=True, kw_only=True)
class Render(Subject):
    """Write an episode to a file: of a policy, of random actions, or a recorded one."""

    source: Positional[Annotated[str, arg(metavar="POLICY|FIELD|EPISODE")]]
    """As for `mbn evaluate`; or a field, with random actions; or an episode's file."""
    out: Path
    """A .json for the episode itself (see `mbn replay`), .gif or .mp4 for an animation, .png, .pdf
    or .svg for its paths."""
    sampled: bool = False
    """Sample the policy's actions instead of taking their mean."""
    seed: int = 0
    """Of the world and of the sampled actions."""
    steps: int | None = None
    """Stop after so many steps; by default at the end of the episode."""
    force: bool = False
    """If the file exists, move it aside (to OUT.1, OUT.2, ...)."""

    def run(self, command_line: str) -> None:
        """Run the episode and write it."""
        from baselines.evaluation.rollout import check_ending, write_episode
        from mbn_marl.files import check_free, claim_file

        few = self.steps is not None and self.steps < 1
        check_options("render", {f"steps: at least 1, not {self.steps}": few})
        check_ending(self.out)
        check_free(self.out, force=self.force)
        episode = self._episode()
        write_episode(episode, claim_file(self.out, force=self.force))
        print(f"{episode.outcome}, {episode.steps} steps, return {episode.team_return:,.0f}")
        print(f"written to {self.out}")

    def _episode(self) -> Episode:
        from baselines.evaluation.rollout import record_episode
        from baselines.policies.load import RANDOM, find_policy
        from mbn_marl.episode import check_episode, is_episode_file, load_episode
        from mbn_marl.episode.files import EXPECTED
        from mbn_marl.errors import FieldError

        if is_episode_file(self.source):
            names = ("field", "condition", "wind", "sampled", "seed", "steps")
            asked = [name for name in names if getattr(self, name) != getattr(Render, name)]
            problem = f"{', '.join(asked)}: not for {self.source}, which is recorded already"
            check_options("render", {problem: asked})
            episode = load_episode(self.source)
            check_episode(episode, self.source)
            return episode
        try:
            how: dict[str, Any] = {"seed": self.seed, "alone": lambda field: RANDOM, **self.asked}
            actor = find_policy(self.source, self.field, **how)
        except FieldError as error:
            if not self.source.lower().endswith(".json"):
                raise
            raise FieldError(self.source, [*error.problems, f"nor is it {EXPECTED}"]) from None
        return record_episode(
            *(actor.policy, actor.place, actor.settings),
            deterministic=not self.sampled,
            seed=self.seed,
            limit=self.steps,
            source=f"{actor.name}{self.weather}{', sampled actions' if self.sampled else ''}",
        )
