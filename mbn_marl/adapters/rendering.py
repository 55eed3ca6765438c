"""Frames for the adapters: the viewer, made when the first frame is asked for."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import gymnasium
import numpy as np
from numpy.typing import NDArray

from mbn_marl.errors import ConfigError
from mbn_marl.render.viewer import RENDER_SIZE, Viewer, size_problems

if TYPE_CHECKING:
    from mbn_marl.engine import BatchEngine

RENDER_FPS = 30


class LazyViewer:
    """Draws worlds of an engine. Pygame is imported and opened with the first frame.

    Args:
        render_mode: one of ``allowed``, or ``None`` for an environment that draws nothing.
        allowed: the render modes of the environment.
        size: width and height of a frame, pixels.

    Raises:
        ConfigError: an unknown render mode, or a size that cannot be.
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
        """The frame of a world, ``(height, width, 3)`` uint8.

        ``None`` in human mode, which shows the frame; and ``None``, with a warning as is the
        custom in both ecosystems, for an environment made without a render mode.
        """
        if self.render_mode is None:
            gymnasium.logger.warn("render() draws nothing: the environment has no render_mode")
            return None
        if self._viewer is None:
            self._viewer = Viewer(self.render_mode, self._size)
        return self._viewer.draw(engine.snapshot(world))

    def close(self) -> None:
        """Close the window, if there is one. A later frame opens it again."""
        if self._viewer is not None:
            self._viewer.close()
            self._viewer = None
