"""The page that replays episodes side by side."""

from __future__ import annotations

from collections.abc import Sequence

from mbn_marl.episode import Episode
from mbn_marl.errors import MbnError
from mbn_marl.version import __version__
from mbn_marl.web import page


def replay_page(episodes: Sequence[Episode], title: str | None = None) -> str:
    """Return a self-contained HTML page that plays ``episodes`` on one clock.

    Without a ``title`` it names the fields.

    Raises:
        MbnError: there is no episode.
    """
    if not episodes:
        raise MbnError("replay: at least one episode is needed")
    fields = ", ".join(dict.fromkeys(episode.field.name for episode in episodes))
    values = {
        "note": f"Recorded and replayed exactly by mbn_marl {__version__}.",
        "episodes": page.episodes_data(episodes),
    }
    return page.whole("replay.html", f"Replay: {fields}" if title is None else title, values)
