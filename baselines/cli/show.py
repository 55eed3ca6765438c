"""``mbn render``, ``replay``, ``watch`` and ``play``: episodes, drawn and recorded."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

from baselines.cli.options import OptionalOutput, Output, Subject, Writes, check_options
from baselines.runs.files import write_text
from mbn_marl.errors import FieldError
from mbn_marl.files import check_ending, check_free, claim_file

if TYPE_CHECKING:
    from mbn_marl.episode import Episode


@dataclass(frozen=True, kw_only=True)
class Render(Subject):
    """Write an episode to a file: of a policy, of random actions, or a recorded one."""

    source: Positional[Annotated[str, arg(metavar="POLICY|FIELD|EPISODE")]]
    """As for `mbn evaluate`; or a field, with random actions; or an episode's file."""
    out: Output
    """The file: a .json for `mbn replay`, .gif or .mp4, or .png, .pdf or .svg for the paths."""
    sampled: bool = False
    """Sample the policy's actions instead of taking their mean."""
    seed: int = 0
    """Of the world and of the sampled actions."""
    steps: int | None = None
    """Stop after so many steps; by default at the end of the episode."""

    def run(self, command_line: str) -> None:
        from baselines.evaluation.rollout import FORMATS, write_episode

        few = self.steps is not None and self.steps < 1
        check_options("render", {f"steps: at least 1, not {self.steps}": few})
        check_free(check_ending(self.out, *FORMATS), force=self.force)
        episode = self._episode()
        write_episode(episode, claim_file(self.out, force=self.force))
        print(result(episode))
        print(f"written to {self.out}")

    def _episode(self) -> "Episode":
        from baselines.evaluation.rollout import record_episode
        from baselines.policies.load import RANDOM, find_policy
        from mbn_marl.episode import check_episode, is_episode_file, load_episode
        from mbn_marl.episode.files import EXPECTED

        if is_episode_file(self.source):
            names = ("field", "condition", "wind", "sampled", "seed", "steps")
            asked = [name for name in names if getattr(self, name) != getattr(Render, name)]
            problem = f"{', '.join(asked)}: not for {self.source}, which is recorded already"
            check_options("render", {problem: asked})
            return check_episode(load_episode(self.source), self.source)
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


def result(episode: "Episode") -> str:
    return f"{episode.outcome}, {episode.steps} steps, return {episode.team_return:,.0f}"


@dataclass(frozen=True)
class Replay(Writes):
    """Write a self-contained HTML page that plays episodes side by side, without a server."""

    episodes: Positional[Annotated[tuple[Path, ...], arg(metavar="EPISODE ...")]]
    """Files of episodes, such as `mbn render RUN -o episode.json` writes."""
    out: Output
    """The .html file to write."""

    def run(self, command_line: str) -> None:
        from mbn_marl.episode import check_episode, load_episode
        from mbn_marl.render.web import replay_page

        check_free(check_ending(self.out, ".html"), force=self.force)
        episodes = {path: load_episode(path) for path in self.episodes}
        shown = [
            replace(check_episode(episode, str(path)), source=f"{episode.source} ({path})")
            for path, episode in episodes.items()
        ]
        page = replay_page(shown)
        write_text(claim_file(self.out, force=self.force), page)
        for episode in episodes.values():
            print(f"{episode.source}: {result(episode)}; replayed exactly")
        print(f"written to {self.out}")


@dataclass(frozen=True, kw_only=True)
class Watch(Subject):
    """Watch a policy in a window. Space pauses, R starts it again, Escape closes it."""

    source: Positional[Annotated[str, arg(metavar="POLICY|FIELD")]]
    """As for `mbn evaluate`; or a field, with its policy of the zoo, else with random actions."""
    sampled: bool = False
    """Sample the policy's actions instead of taking their mean."""
    seed: int = 0
    """Of the worlds and of sampled actions."""
    speed: float = 10.0
    """Steps a second."""
    episodes: int | None = None
    """Close the window after so many."""
    out: OptionalOutput = None
    """Write the last episode to this .json file (see `mbn replay`)."""

    def run(self, command_line: str) -> None:
        from baselines.evaluation.window import watch
        from baselines.policies.load import find_policy, of_zoo
        from mbn_marl.episode import save_episode

        how: dict[str, Any] = {"seed": self.seed, "alone": of_zoo, **self.asked}
        actor = find_policy(self.source, self.field, **how)
        if self.out is not None:
            check_free(check_ending(self.out, ".json"), force=self.force)
        shown = watch(
            actor,
            driven=self.robot if isinstance(self, Play) else None,
            deterministic=not self.sampled,
            seed=self.seed,
            speed=self.speed,
            episodes=self.episodes,
        )
        for episode in shown:
            print(result(episode))
        if self.out is not None and shown:
            save_episode(shown[-1], claim_file(self.out, force=self.force))
            print(f"written to {self.out}")


@dataclass(frozen=True, kw_only=True)
class Play(Watch):
    """Drive one robot with the arrow keys or W, A, S, D, while a policy drives the others."""

    robot: int = 0
    """The number of your robot."""
