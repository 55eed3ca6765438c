"""Frames for the adapters, from a viewer that is made with the first frame."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from mbn_marl.errors import ConfigError
from mbn_marl.render.viewer import RENDER_SIZE, Viewer, size_problems

if TYPE_CHECKING:
    from mbn_marl.engine import BatchEngine

RENDER_FPS = 30


class LazyViewer:
    """Draws worlds of an engine; imports and opens Pygame with the first frame.

    Args:
        render_mode: one of ``allowed``, or ``None`` for an environment that draws nothing.
        allowed: the render modes of the environment.
        size: width and height of a frame, pixels.

    Raises:
        ConfigError: an unknown render mode, or a size that is not allowed.
    """

    def __init__(
        self, render_mode: str | None, allowed: Sequence[str], size: tuple[int, int] = RENDER_SIZE
    ) -> None:
        problems = size_problems("render_size", size)
        if render_mode is not None and render_mode not in allowed:
            known = ", ".join(map(repr, allowed))
            problems.append(f"render_mode: unknown mode {render_mode!r}; known: {known}, or None")
        if problems:
            raise ConfigError("environment", problems)
        self.render_mode, self._size = render_mode, (size[0], size[1])
        self._viewer: Viewer | None = None

    def draw(self, engine: BatchEngine, world: int = 0) -> NDArray[np.uint8] | None:
        """Return the frame of a world, ``(height, width, 3)`` uint8, or show it in human mode.

        Without a render mode, return ``None`` with a warning, as Gymnasium and PettingZoo do.
        """
        if self.render_mode is None:
            gymnasium.logger.warn("render() draws nothing: the environment has no render_mode")
            return None
        if self._viewer is None:
            self._viewer = Viewer(self.render_mode, self._size)
        return self._viewer.draw(engine.snapshot(world))

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the viewer, which a copy or another process opens anew."""
        return {**self.__dict__, "_viewer": None}

    def close(self) -> None:
        """Close the window, if there is one. A later frame opens it again."""
        if self._viewer is not None:
            self._viewer.close()
            self._viewer = None
