"""Valid fields and files that the tests of fields start from."""

import math
from pathlib import Path
from typing import Any

from mbn_marl.field import FORMAT, Field

SQUARE = [(0.0, 0.0), (100.0, 0.0), (100.0, 100.0), (0.0, 100.0)]
HOLE = [(40.0, 40.0), (60.0, 40.0), (60.0, 60.0), (40.0, 60.0)]
LETTER_L = [(0.0, 0.0), (100.0, 0.0), (100.0, 50.0), (60.0, 50.0), (60.0, 100.0), (0.0, 100.0)]

VALID_FILE = f"""\
format: {FORMAT}
vertices: [[0, 0], [100, 0], [100, 100], [0, 100]]
rois: [[90, 90]]
starts: [[10, 10], [10, 90]]
"""


def square(**changes: Any) -> Field:
    values = {
        "vertices": SQUARE,
        "rois": [(90.0, 90.0)],
        "starts": [(10.0, 10.0), (10.0, 90.0)],
        "holes": [HOLE],
    }
    return Field(**(values | changes))


def circle(corners: int) -> list[tuple[float, float]]:
    angles = [math.tau * k / corners for k in range(corners)]
    return [(50 + 50 * math.cos(angle), 50 + 50 * math.sin(angle)) for angle in angles]


def write(folder: Path, text: str, name: str = "user.yaml") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path
