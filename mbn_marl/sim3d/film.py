"""A film of a mission in MuJoCo: a camera, the robots' paths, and an MP4 file."""

from __future__ import annotations

import importlib
import os
import sys
from ctypes.util import find_library
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbn_marl.errors import ConfigError, MbnError, load
from mbn_marl.render import style
from mbn_marl.render.animation import FPS, Mp4Writer
from mbn_marl.sim3d.scene import PICTURE

CAMERAS = ("field", "top", "chase")
SPEED = 2.0  # the seconds of the mission in one of the film
REST = 20  # frames that a film rests on its end
PATH_HEIGHT, PATH_WIDTH, APART = 0.03, 0.05, 0.1  # of a path, and between two of its points, metres
MOST_SHAPES = 20_000


class Film:
    """Films one mission, with 20 frames a second at twice its speed, to an ``.mp4`` file.

    The camera looks across the ``"field"``, from the ``"top"`` or behind the first robot.
    """

    def __init__(self, path: str | Path, camera: str = "field") -> None:
        if camera not in CAMERAS:
            raise ConfigError("film", [f"camera: {camera!r}; allowed: {', '.join(CAMERAS)}"])
        self._writer, self._camera = Mp4Writer(path), camera
        self._renderer: Any = None
        self._begun = False

    def begin(self, model: Any, data: Any, places: NDArray[np.intp]) -> None:
        """Begin, or end at a second mission; robots are at ``data.qpos[places]``, (n, 2)."""
        if self._begun:
            return self.close()
        self._begun, (width, height) = True, PICTURE
        try:
            self._renderer = load_mujoco().Renderer(model, height, width, max_geom=MOST_SHAPES)
        except Exception as error:  # each platform's OpenGL raises its own
            raise MbnError(
                f"a film needs OpenGL, which cannot be used here ({error}); without a display "
                "install EGL (Debian: libegl1 libgl1), or set MUJOCO_GL=osmesa"
            ) from error
        self._data, self._places, self._due = data, places, data.time
        self._paths = [data.qpos[places]]
        return self.look()

    def look(self) -> None:
        """Lengthen the paths, and take a frame if it is time for one."""
        if self._renderer is None:
            return
        now = self._data.qpos[self._places]
        if np.abs(now - self._paths[-1]).max() > APART:
            self._paths.append(now)
        if self._data.time >= self._due - 1e-9:
            self._due += SPEED / FPS
            self._writer.add(self._draw())

    def _draw(self) -> Any:
        mujoco, scene = load_mujoco(), self._renderer.scene
        self._renderer.update_scene(self._data, camera=self._camera)
        points = np.array([*self._paths, self._data.qpos[self._places]])
        ends = np.dstack([points, np.full(points.shape[:2], PATH_HEIGHT)])
        kind = mujoco.mjtGeom.mjGEOM_CAPSULE
        for robot in range(ends.shape[1]):
            colour = np.array([*style.rgb(style.robot_colour(robot)), 255.0], np.float32) / 255.0
            for k in range(min(len(ends) - 1, scene.maxgeom - scene.ngeom)):
                shape = scene.geoms[scene.ngeom]
                mujoco.mjv_initGeom(shape, kind, np.zeros(3), np.zeros(3), np.zeros(9), colour)
                mujoco.mjv_connector(shape, kind, PATH_WIDTH, ends[k, robot], ends[k + 1, robot])
                scene.ngeom += 1
        return self._renderer.render()

    def discard(self) -> None:
        """Leave no film, while an error is handled."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
            self._writer.__exit__(*sys.exc_info())

    def close(self) -> None:
        """Rest on the end, and complete the file; closing twice does no harm."""
        if self._renderer is not None:
            picture = self._draw()
            for _ in range(REST):
                self._writer.add(picture)
            self._renderer.close()
            self._renderer = None
            self._writer.close()


def load_mujoco() -> Any:
    """Return MuJoCo, if it is installed; without a display it draws by EGL, if there is one."""
    headless = sys.platform == "linux" and not os.environ.get("DISPLAY")
    # MuJoCo reads MUJOCO_GL when it is first imported, which another package may have done.
    late = headless and "MUJOCO_GL" not in os.environ and "mujoco" in sys.modules
    if headless:
        os.environ.setdefault("MUJOCO_GL", "egl" if find_library("EGL") else "disable")
    mujoco = load("mujoco", "sim3d")
    if late:
        importlib.reload(sys.modules[mujoco.Renderer.__module__].gl_context)
    return mujoco
