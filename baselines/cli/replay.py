"""``mbn replay``: episodes as a page that plays them in a browser."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg


@dataclass(frozen=True)
class Replay:
    """Write a self-contained HTML page that plays episodes side by side, without a server."""

    episodes: Positional[Annotated[tuple[Path, ...], arg(metavar="EPISODE ...")]]
    """Files of episodes, such as `mbn render RUN -o episode.json` writes."""
    out: Path
    """The .html file to write."""
    title: str | None = None
    """Of the page; by default the fields' names."""
    force: bool = False
    """If the file exists, move it aside (to OUT.1, OUT.2, ...)."""

    def run(self, command_line: str) -> None:
        """Check every episode in the engine, and write the page."""
        from mbn_marl.episode import check_episode, load_episode
        from mbn_marl.errors import MbnError
        from mbn_marl.files import check_free, claim_file, replacing
        from mbn_marl.render.web import replay_page

        if self.out.suffix.lower() != ".html":
            raise MbnError(f"{self.out}: the file name has to end in .html")
        check_free(self.out, force=self.force)
        episodes = [load_episode(path) for path in self.episodes]
        for episode, path in zip(episodes, self.episodes, strict=True):
            check_episode(episode, str(path))
        shown = [
            replace(episode, source=f"{episode.source} ({path})")
            for episode, path in zip(episodes, self.episodes, strict=True)
        ]
        page = replay_page(shown, self.title)
        with replacing(claim_file(self.out, force=self.force)) as temporary:
            temporary.write_text(page, encoding="utf-8")
        for episode in episodes:
            print(
                f"{episode.source}: {episode.outcome}, {episode.steps} steps, "
                f"return {episode.team_return:,.0f}; replayed exactly"
            )
        print(f"written to {self.out}")
