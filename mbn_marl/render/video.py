"""Writes frames as a video: H.264 in MP4, which every browser and office program plays."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from mbn_marl.errors import MbnError
from mbn_marl.files import replacing
from mbn_marl.render.frames import check_frame, checked_frames

FASTEST = 120.0
_QUALITY = 8
"""Of 10; below it, thin lines fray."""
_EVEN = 2
"""Sides have to be a multiple of this: colour is stored for every second pixel."""


class Mp4Writer:
    """Writes a video frame by frame, in a ``with`` block or until it is closed.

    Args:
        path: an ``.mp4`` file; missing folders are made, and a file is replaced only once the new
            one is complete.
        fps: frames per second, above 0, at most 120.

    Raises:
        MbnError: naming the path, or the number that is wrong.
        ImportError: if imageio-ffmpeg is not installed.
    """

    def __init__(self, path: str | Path, fps: float = 20.0) -> None:
        self.path = Path(path)
        if self.path.suffix.lower() != ".mp4":
            raise MbnError(f"{self.path}: the file name has to end in .mp4")
        if not 0.0 < fps <= FASTEST:
            raise MbnError(f"{self.path}: fps has to be above 0, at most {FASTEST:g}, not {fps}")
        try:
            import imageio_ffmpeg
        except ModuleNotFoundError as error:
            raise ImportError(
                'writing a video needs imageio-ffmpeg: pip install "mbn_marl[render]"',
                name="imageio_ffmpeg",
            ) from error
        self._ffmpeg, self._fps, self._count = imageio_ffmpeg, fps, 0
        self._open = ExitStack()

    def add(self, frame: NDArray[Any]) -> None:
        """Append a frame.

        Args:
            frame: uint8 (height, width, 3), all of one shape; an odd side loses a pixel.

        Raises:
            MbnError: it is something else.
            OSError: naming the path, if it cannot be written.
        """
        if self._count == 0:
            check_frame(frame, 0, frame.shape, self.path)
            self._begin(frame.shape)
        check_frame(frame, self._count, self._shape, self.path)
        height, width = self._size
        self._writer.send(np.ascontiguousarray(frame[:height, :width]))
        self._count += 1

    def _begin(self, shape: tuple[int, ...]) -> None:
        self._shape = shape
        height, width = self._size = tuple(side // _EVEN * _EVEN for side in shape[:2])
        temporary = self._open.enter_context(replacing(self.path))
        self._writer = self._ffmpeg.write_frames(
            temporary, (width, height), fps=self._fps, quality=_QUALITY, macro_block_size=_EVEN
        )
        self._open.callback(self._writer.close)
        self._writer.send(None)

    def close(self) -> None:
        """Complete the file, if there was a frame; closing twice does no harm."""
        self._open.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._open.__exit__(kind, error, traceback)


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
    with Mp4Writer(path, fps) as writer:
        for picture in checked_frames(frames, writer.path):
            writer.add(picture)
    return writer.path
