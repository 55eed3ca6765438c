"""Windows, arrays, GIFs and videos; :mod:`mbn_marl.render.figures` alone loads matplotlib."""

from mbn_marl.render.animation import write_gif, write_mp4
from mbn_marl.render.viewer import RENDER_MODES, Viewer

__all__ = ["RENDER_MODES", "Viewer", "write_gif", "write_mp4"]
