"""Writes frames as a video: H.264 in MP4, which every browser and office program plays."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import closing
from itertools import chain
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from mbn_marl.errors import MbnError
from mbn_marl.render.files import replacing
from mbn_marl.render.frames import checked_frames

FASTEST = 120.0
_QUALITY = 8
"""Of 10; below it, thin lines fray."""
_EVEN = 2
"""Sides have to be a multiple of this: colour is stored for every second pixel."""


def write_mp4(frames: Iterable[NDArray[Any]], path: str | Path, fps: float = 20.0) -> Path:
    """Write ``frames`` to ``path``.

    Args:
        frames: uint8 arrays, all of one shape (height, width, 3); an odd side loses a pixel.
        path: an ``.mp4`` file; missing folders are made, and a file is replaced only once the new
            one is complete.
        fps: frames per second, above 0, at most 120.

    Returns:
        The path.

    Raises:
        MbnError: naming the path, the frame or the number that is wrong.
        ImportError: if imageio-ffmpeg is not installed.
        OSError: naming the path, if it cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".mp4":
        raise MbnError(f"{path}: the file name has to end in .mp4")
    if not 0.0 < fps <= FASTEST:
        raise MbnError(f"{path}: fps has to be above 0, at most {FASTEST:g}, not {fps}")
    pictures = checked_frames(frames, path)
    try:
        import imageio_ffmpeg
    except ModuleNotFoundError as error:
        raise ImportError(
            'writing a video needs imageio-ffmpeg: pip install "mbn_marl[render]"',
            name="imageio_ffmpeg",
        ) from error
    first = next(pictures)
    height, width = (side // _EVEN * _EVEN for side in first.shape[:2])
    with replacing(path) as temporary:
        writer = imageio_ffmpeg.write_frames(
            temporary, (width, height), fps=fps, quality=_QUALITY, macro_block_size=_EVEN
        )
        with closing(writer):
            writer.send(None)
            for picture in chain([first], pictures):
                writer.send(picture[:height, :width].tobytes())
    return path
