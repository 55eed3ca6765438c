"""GIF and MP4: what they hold, what is refused, and what is held in memory."""

import tracemalloc
from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from mbn_marl.errors import MbnError
from mbn_marl.render import Viewer, write_gif, write_mp4
from tests.support.pictures import SIZE, draw, snapshot, wander

SQUARE = np.zeros((4, 4, 3), np.uint8)


def still_frames(count: int) -> Iterator[NDArray[np.uint8]]:
    """Frames of 480 kB, one after the other."""
    for level in range(count):
        yield np.full((400, 400, 3), level, np.uint8)


@pytest.mark.parametrize(
    ("frames", "name", "place"),
    [
        ([], "a.gif", "no frames"),
        ([SQUARE.astype(float)], "a.gif", "frame 0"),
        ([SQUARE, np.zeros((4, 5, 3), np.uint8)], "a.gif", "frame 1"),
        ([SQUARE], "a.png", r"\.gif"),
        ([*still_frames(3), SQUARE], "a.mp4", "frame 3"),
    ],
)
def test_wrong_animation_is_refused_and_nothing_replaced(frames, name, place, tmp_path):
    path, write = tmp_path / name, write_mp4 if name == "a.mp4" else write_gif
    path.write_bytes(b"old")
    with pytest.raises(MbnError, match=rf"{name}: .*{place}"):
        write(frames, path)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path], "no temporary file is left"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["a.gif", "a.mp4"])
def test_animation_is_written_without_holding_its_frames(name, tmp_path):
    write = write_gif if name == "a.gif" else write_mp4
    write(still_frames(2), tmp_path / name)  # what is loaded the first time is not counted
    tracemalloc.start()
    write(still_frames(60), tmp_path / name)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 20 * 480_000, f"{peak / 1e6:.0f} MB for 60 frames of 0.48 MB"


def test_gif_holds_the_frames_and_is_small(tmp_path):
    trail, viewer = wander(30, 3), Viewer("rgb_array", SIZE)
    frames = [draw(snapshot(trail[: step + 1]), viewer) for step in range(31)]
    path = write_gif(frames, tmp_path / "new" / "episode.gif")
    with Image.open(path) as gif:
        assert (gif.n_frames, gif.info["duration"], gif.info["loop"]) == (31, 50, 0)
        gif.seek(30)
        shown = np.asarray(gif.convert("RGB"), np.int64)
    error = np.abs(shown - frames[-1])
    assert error.mean() < 2.0 and error.max() < 32, "the colours of the last frame are kept"
    assert path.stat().st_size < 31 * 4000
