"""Frames for the adapters: the viewer, made when the first frame is asked for."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import gymnasium
import numpy as np
from numpy.typing import NDArray

from mbn_marl.errors import ConfigError

if TYPE_CHECKING:
    from mbn_marl.engine import BatchEngine
    from mbn_marl.render.viewer import Viewer

RENDER_FPS = 30


class LazyViewer:
    """Draws worlds of an engine. Pygame is imported and opened with the first frame.

    Args:
        render_mode: one of ``allowed``, or ``None`` for an environment that draws nothing.
        allowed: the render modes of the environment.

    Raises:
        ConfigError: an unknown render mode.
    """

    def __init__(self, render_mode: str | None, allowed: Sequence[str]) -> None:
        if render_mode is not None and render_mode not in allowed:
            known = ", ".join(map(repr, allowed))
            problem = f"render_mode: unknown mode {render_mode!r}; known: {known}, or None"
            raise ConfigError("environment", [problem])
        self.render_mode = render_mode
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
            from mbn_marl.render.viewer import Viewer

            self._viewer = Viewer(self.render_mode)
        return self._viewer.draw(engine.snapshot(world))

    def close(self) -> None:
        """Close the window, if there is one. A later frame opens it again."""
        if self._viewer is not None:
            self._viewer.close()
            self._viewer = None
