"""A film of a mission in MuJoCo: a camera, the robots' paths, and an MP4 file."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Sequence
from ctypes.util import find_library
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbn_marl.errors import ConfigError, MbnError, install
from mbn_marl.render import style
from mbn_marl.render.animation import Mp4Writer
from mbn_marl.sim3d.scene import CAMERAS, LARGEST_PICTURE

PATH_HEIGHT, PATH_WIDTH, APART = 0.03, 0.05, 0.1
"""Of the paths, which lie on the ground, and between two points of one, metres."""
MOST_SHAPES = 20_000
REST = 1.0  # seconds that a film rests on its end


class Film:
    """Films one mission.

    Args:
        path: an ``.mp4`` file.
        camera: ``"field"``, ``"top"`` or ``"chase"``.
        size: width and height of the picture, pixels, at most 1920 x 1080.
        fps: frames per second.
        speed: how much faster than the simulation the film runs.

    Attributes:
        begun: whether it has filmed anything.

    Raises:
        ConfigError: a camera or a number is not allowed.
        MbnError: the file's name does not end in ``.mp4``.
    """

    def __init__(
        self,
        path: str | Path,
        camera: str = "field",
        *,
        size: tuple[int, int] = (960, 720),
        fps: float = 20.0,
        speed: float = 2.0,
    ) -> None:
        problems = []
        if camera not in CAMERAS:
            problems.append(f"camera: {camera!r}; allowed: {', '.join(CAMERAS)}")
        if not _can_be(size):
            problems.append(f"size: {size}; allowed: two numbers, 16 to {LARGEST_PICTURE} pixels")
        if not 0.0 < speed < np.inf:
            problems.append(f"speed: {speed}; allowed: a finite number above 0")
        if problems:
            raise ConfigError("film", problems)
        self._writer = Mp4Writer(path, fps=fps)
        self._camera, self._size, self._period = camera, size, speed / fps
        self._rest = round(fps * REST)
        self._renderer: Any = None
        self.begun = False

    def begin(self, model: Any, data: Any, places: NDArray[np.intp]) -> None:
        """Begin with the first frame; ``places`` (n, 2) are the robots' x and y in ``data.qpos``.

        Raises:
            MbnError: there is no OpenGL to draw with.
        """
        self.begun = True
        width, height = self._size
        try:
            self._renderer = load_mujoco().Renderer(model, height, width, max_geom=MOST_SHAPES)
        except Exception as error:  # whatever the platform's OpenGL raises
            raise MbnError(
                f"a film needs OpenGL, which cannot be used here ({error}); without a display "
                "install EGL (Debian: libegl1 libgl1), or set MUJOCO_GL=osmesa"
            ) from error
        self._data = data
        self._places, self._paths, self._due = places, [data.qpos[places]], data.time
        self.look()

    def look(self) -> None:
        """Lengthen the paths, and take a frame if it is time for one."""
        now = self._data.qpos[self._places]
        if np.abs(now - self._paths[-1]).max() > APART:
            self._paths.append(now)
        if self._data.time >= self._due - 1e-9:
            self._due += self._period
            self._writer.add(self._draw())

    def _draw(self) -> Any:
        mujoco, scene = load_mujoco(), self._renderer.scene
        self._renderer.update_scene(self._data, camera=self._camera)
        points = np.array([*self._paths, self._data.qpos[self._places]])
        ends = np.dstack([points, np.full(points.shape[:2], PATH_HEIGHT)])
        for robot in range(ends.shape[1]):
            colour = np.array([*style.rgb(style.robot_colour(robot)), 255.0], np.float32) / 255.0
            for k in range(len(ends) - 1):
                if scene.ngeom >= scene.maxgeom:
                    break
                shape = scene.geoms[scene.ngeom]
                kind = mujoco.mjtGeom.mjGEOM_CAPSULE
                mujoco.mjv_initGeom(shape, kind, np.zeros(3), np.zeros(3), np.zeros(9), colour)
                mujoco.mjv_connector(shape, kind, PATH_WIDTH, ends[k, robot], ends[k + 1, robot])
                scene.ngeom += 1
        return self._renderer.render()

    def close(self) -> None:
        """Rest on how it ended, and complete the file; closing twice does no harm."""
        if self._renderer is not None:
            picture = self._draw()
            for _ in range(self._rest):
                self._writer.add(picture)
            self._renderer.close()
            self._renderer = None
            self._writer.close()


def _can_be(size: object) -> bool:
    """Return whether a picture can have this size."""
    return (
        isinstance(size, Sequence)
        and len(size) == len(LARGEST_PICTURE)
        and all(isinstance(side, int | np.integer) for side in size)
        and all(16 <= side <= most for side, most in zip(size, LARGEST_PICTURE, strict=True))
    )


def load_mujoco() -> Any:
    """Return MuJoCo, which draws by EGL, if there is one, where there is no display.

    MuJoCo chooses how to draw when it is first imported, which another package may have done;
    ``MUJOCO_GL`` decides.

    Raises:
        ImportError: it is not installed, naming the extra that brings it.
    """
    headless = sys.platform == "linux" and not os.environ.get("DISPLAY")
    late = headless and "MUJOCO_GL" not in os.environ and "mujoco" in sys.modules
    if headless:
        os.environ.setdefault("MUJOCO_GL", "egl" if find_library("EGL") else "disable")
    try:
        import mujoco
    except ModuleNotFoundError as error:
        raise ImportError(
            f"simulating vehicles needs MuJoCo: {install('sim3d')}", name="mujoco"
        ) from error
    if late:
        importlib.reload(sys.modules[mujoco.Renderer.__module__].gl_context)
    return mujoco
