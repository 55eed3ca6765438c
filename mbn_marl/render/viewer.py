"""Show snapshots as pygame pictures: in a window, or as arrays with no display at all."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mbn_marl.errors import ConfigError, DisplayError, load

if TYPE_CHECKING:
    import pygame

    from mbn_marl.engine.snapshot import Snapshot
    from mbn_marl.render.scene import Scene

RENDER_MODES = ("human", "rgb_array")
RENDER_SIZE = (800, 800)  # width and height of a picture, pixels, unless given
SMALLEST_SIDE = 200
UNSEEN = "offscreen"  # the driver that SDL falls back to where there is no display


class Viewer:
    """Draws snapshots at one size. pygame is imported at the first drawing.

    Args:
        render_mode: ``"human"`` (a window) or ``"rgb_array"`` (arrays; opens no display).
        size: width and height of the picture, pixels, each at least 200; the field keeps its shape.
        frame_rate: frames per second at most, in a window; above 0.
        caption: of the window.
        own: the index of the robot to mark as the user's; ``None`` for none.
        keys: a line below the field, about the keys; none if empty.
    """

    def __init__(
        self,
        render_mode: str,
        size: tuple[int, int] = RENDER_SIZE,
        frame_rate: float = 30.0,
        caption: str = "mbn_marl",
        own: int | None = None,
        keys: str = "",
    ) -> None:
        problems = []
        if render_mode not in RENDER_MODES:
            known = " or ".join(map(repr, RENDER_MODES))
            problems.append(f"render_mode: {known}, not {render_mode!r}")
        problems += size_problems("size", size)
        if not isinstance(frame_rate, int | float) or not frame_rate > 0.0:
            problems.append(f"frame_rate: a number above 0, not {frame_rate!r}")
        if problems:
            raise ConfigError("viewer", problems)
        self.render_mode, self.size = render_mode, size
        self.frame_rate, self.caption = frame_rate, caption
        self.own, self.keys = own, keys
        self.closed = False  # by the window's button, by Escape or by ``close``
        self.pressed: list[str] = []  # keys, since the frame before
        self.held: set[str] = set()
        self._scene: Scene | None = None
        self._window: pygame.Surface | None = None

    def draw(self, snapshot: Snapshot) -> NDArray[np.uint8] | None:
        """Return a new (height, width, 3) uint8 array, or ``None`` and show it in a window."""
        if self._scene is None:
            os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
            load("pygame", "render")
            from mbn_marl.render.scene import Scene

            self._scene = Scene(self.size, self.own, self.keys)
        if self.render_mode == "rgb_array":
            return self._scene.pixels(snapshot)
        if not self.closed:
            self._show(self._scene.draw(snapshot))
        return None

    def close(self) -> None:
        self.closed = True
        if self._window is not None:
            import pygame

            self._window = None
            pygame.display.quit()

    def _show(self, frame: pygame.Surface) -> None:
        import pygame

        # Another viewer that was closed has closed the display.
        if self._window is None or pygame.display.get_surface() is None:
            try:
                pygame.display.init()
                if pygame.display.get_driver() == UNSEEN and "SDL_VIDEODRIVER" not in os.environ:
                    pygame.display.quit()
                    raise pygame.error("there is none")
                self._window = pygame.display.set_mode(self.size)
            except pygame.error as error:
                raise DisplayError(
                    f"render_mode='human' needs a display ({error}); "
                    "render_mode='rgb_array' and `mbn render` draw without one"
                ) from error
            pygame.display.set_caption(self.caption)
            self._clock = pygame.time.Clock()
        self._window.blit(frame, (0, 0))
        pygame.display.flip()
        self.pressed = []
        for event in pygame.event.get():
            escape = event.type == pygame.KEYDOWN and event.key == pygame.K_ESCAPE
            if escape or event.type == pygame.QUIT:
                self.close()
                return
            if event.type == pygame.KEYDOWN:
                self.pressed.append(pygame.key.name(event.key))
                self.held.add(self.pressed[-1])
            elif event.type == pygame.KEYUP:
                self.held.discard(pygame.key.name(event.key))
        self._clock.tick(self.frame_rate)


def size_problems(name: str, size: object) -> list[str]:
    sides = size if isinstance(size, (tuple, list)) else ()
    if [isinstance(side, int) and side >= SMALLEST_SIDE for side in sides] == [True, True]:
        return []
    allowed = f"width and height in pixels, whole numbers of at least {SMALLEST_SIDE}"
    return [f"{name}: allowed: {allowed}, not {size!r}"]
