"""The calls that an engine makes to those who follow its worlds."""

from __future__ import annotations

from typing import Any, Protocol


class Listener(Protocol):
    """Receives every reset and step of an engine's worlds, after it has happened."""

    def was_reset(self, mask: Any) -> None:
        """The worlds of a mask (W,) bool, or all if it is ``None``, have another state."""

    def stepped(self, actions: Any, ended: Any) -> None:
        """The worlds moved by ``actions`` (W, n, 2), as given; in ``ended`` (W,) an episode ended.

        Worlds that waited for a reset did not move.
        """
