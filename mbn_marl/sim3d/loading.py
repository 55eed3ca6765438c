"""Loading MuJoCo, which is no dependency of the package itself."""

from __future__ import annotations

import importlib
import os
import sys
from ctypes.util import find_library
from types import ModuleType


def load_mujoco() -> ModuleType:
    """MuJoCo. Without a display it draws by EGL, if there is one, unless ``MUJOCO_GL`` says how.

    MuJoCo chooses how to draw when it is first imported, which another package may have done.

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
            'simulating vehicles needs MuJoCo: pip install "mbn_marl[sim3d]"', name="mujoco"
        ) from error
    if late:
        importlib.reload(sys.modules[mujoco.Renderer.__module__].gl_context)
    module: ModuleType = mujoco
    return module
