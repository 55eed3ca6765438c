"""The looks of robots and curves: distinct for all eyes, and the same everywhere."""

from __future__ import annotations

import numpy as np
import pytest

from mbn_marl.render import style

# Machado, Oliveira, Fernandes, 2009 (severity 1).
SIGHTS = {
    "normal": np.eye(3),
    "protan": [
        (0.152286, 1.052583, -0.204868),
        (0.114503, 0.786281, 0.099216),
        (-0.003882, -0.048116, 1.051998),
    ],
    "deutan": [
        (0.367322, 0.860646, -0.227968),
        (0.280085, 0.672501, 0.047413),
        (-0.011820, 0.042940, 0.968881),
    ],
    "tritan": [
        (1.255528, -0.076749, -0.178779),
        (-0.078411, 0.930809, 0.147602),
        (0.004733, 0.691367, 0.303900),
    ],
}
# OKLab: Ottosson, "A perceptual color space", 2020.
TO_CONES = [
    (0.4122214708, 0.5363325363, 0.0514459929),
    (0.2119034982, 0.6806995451, 0.1073969566),
    (0.0883024619, 0.2817188376, 0.6299787005),
]
TO_LAB = [
    (0.2104542553, 0.7936177850, -0.0040720468),
    (1.9779984951, -2.4285922050, 0.4505937099),
    (0.0259040371, 0.7827717662, -0.8086757660),
]


@pytest.mark.parametrize("sight", SIGHTS)
def test_colours_of_robots_are_clearly_distinct_for_all_eyes(sight: str) -> None:
    """Distances are 100 times those of OKLab; below 2 two patches side by side look the same."""
    shown = np.array([style.rgb(style.robot_colour(index)) for index in range(10)]) / 255.0
    linear = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
    seen = np.clip(linear @ np.transpose(SIGHTS[sight]), 0.0, 1.0)
    places = 100.0 * np.cbrt(seen @ np.transpose(TO_CONES)) @ np.transpose(TO_LAB)
    apart = np.linalg.norm(places[:, None] - places[None], axis=2)
    assert apart[~np.eye(10, dtype=bool)].min() > (15.0 if sight == "normal" else 8.0)


def test_series_in_a_row_differ_in_colour_dash_and_marker() -> None:
    looks = [style.series(index) for index in range(30)]
    for index in range(28):
        for aspect in zip(*looks[index : index + 3], strict=True):
            assert len(set(aspect)) == 3
    assert len({(look.dash, look.marker) for look in looks}) == 30  # so in grey print too
