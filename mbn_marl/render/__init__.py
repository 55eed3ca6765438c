"""Looks at the environment and never steps it: windows, arrays, GIFs, videos and figures.

Importing this package loads neither pygame nor matplotlib; :mod:`mbn_marl.render.figures` is
imported by name, as it needs matplotlib.
"""

from mbn_marl.render.animation import write_gif, write_mp4
from mbn_marl.render.viewer import RENDER_MODES, Viewer

__all__ = ["RENDER_MODES", "Viewer", "write_gif", "write_mp4"]
