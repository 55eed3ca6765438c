"""Figures: what they show is in the right place, and what cannot be shown is refused."""

import subprocess
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mbn_marl.config import make_config
from mbn_marl.episode import play
from mbn_marl.errors import MbnError
from mbn_marl.field import Field, load_field
from mbn_marl.render import figures, style
from tests.support.pictures import HOLE, SQUARE, draw, snapshot

ROIS = [(150.0, 150.0), (250.0, 250.0)]
STARTS = [(120.0, 200.0), (280.0, 200.0)]
FIELD = Field(SQUARE, ROIS, STARTS)
TRAILS = np.array([[[120, 200], [280, 200]], [[125, 205], [270, 200]], [[135, 215], [255, 205]]])
END = TRAILS[-1:].tolist()[0]


def drawn(trail: Any = TRAILS, **changes: Any) -> Figure:
    figure = figures.trajectory_figure(snapshot(trail, field=FIELD, **changes))
    FigureCanvasAgg(figure).draw()
    return figure


def colour_at(figure: Figure, point: tuple[float, float]) -> tuple[int, ...]:
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    picture = np.asarray(canvas.buffer_rgba())
    x, y = figure.axes[0].transData.transform(point)
    return tuple(int(value) for value in picture[picture.shape[0] - 1 - round(y), round(x), :3])


def lines_of(figure: Figure, colour: str) -> list[NDArray[np.float64]]:
    lines = figure.axes[0].lines
    return [line.get_xydata() for line in lines if to_rgb(line.get_color()) == to_rgb(colour)]


def marked(figure: Figure, marker: str) -> list[Any]:
    lines = figure.axes[0].lines
    return [line.get_xydata().tolist() for line in lines if line.get_marker() == marker]


def labels_of(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


@pytest.mark.parametrize("outline", [SQUARE, SQUARE[::-1]])
def test_field_is_drawn_to_scale_with_holes_rois_and_starts(outline):
    figure = figures.field_figure(Field(outline, ROIS, STARTS, holes=[HOLE[::-1]]))
    axes = figure.axes[0]
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    assert left < 100.0 < 300.0 < right and bottom < 100.0 < 300.0 < top
    assert axes.get_aspect() == 1.0
    for outside in ((200.0, 200.0), (95.0, 200.0)):
        assert colour_at(figure, outside) == style.rgb(style.OBSTACLE)
    assert colour_at(figure, (200.0, 240.0)) == style.rgb(style.GROUND)
    circles = [patch for patch in axes.patches if hasattr(patch, "radius")]
    assert [circle.center for circle in circles] == ROIS
    assert {circle.radius for circle in circles} == {10.0}
    starts = [lines_of(figure, style.robot_colour(index)) for index in (0, 1)]
    assert np.array_equal(starts, [[[STARTS[0]]], [[STARTS[1]]]])
    assert labels_of(figure) == ["ROI", "start of robot i"]


def test_many_fields_are_drawn_whole_each_with_its_bar():
    small = Field([(0, 0), (40, 0), (40, 40), (0, 40)], [(20, 20)], [(5, 5)])
    figure = figures.fields_figure([FIELD, small])
    for axes, field, bar in zip(figure.axes, (FIELD, small), (50.0, 10.0), strict=True):
        (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
        for x, y in field.vertices:
            assert left < x < right and bottom < y < top
        (line,) = [line for line in axes.lines if len(line.get_xdata()) == 2]
        assert np.ptp(line.get_xdata()) == pytest.approx(bar)
        assert axes.texts[-1].get_text() == f"{bar:g} units"
    with pytest.raises(MbnError):
        figures.fields_figure([])


def test_each_robot_has_its_path_from_start_to_end():
    figure = drawn(visited=np.array([True, False]))
    for index in (0, 1):
        path, *_, start, end = lines_of(figure, style.robot_colour(index))
        assert np.array_equal(path, TRAILS[:, index])
        assert np.array_equal([start, end], TRAILS[[0, -1], index][:, None])
    assert labels_of(figure) == ["ROI", "ROI, visited", "start", "end of robot i"]
    assert marked(figure, "$\\checkmark$") == [[list(ROIS[0])]]


def test_headings_and_failures_are_marked():
    turned = {"headings": np.array([np.nan, 0.5]), "failed": np.array([True, False])}
    figure, pair = drawn(**turned), (snapshot(TRAILS), snapshot(TRAILS, **turned))
    both = figures.overlay_panels({"one": pair}, ("plane", "mujoco"))
    for one in (figure, both):
        assert marked(one, "x") == [[END[0]]]
    (nose,) = [line for line in figure.axes[0].lines if not isinstance(line.get_marker(), str)]
    assert nose.get_xydata().tolist() == [END[1]]
    tip = nose._marker.get_transform().transform((1.0, 0.0))
    assert np.arctan2(*tip[::-1]) == pytest.approx(0.5)
    assert "failed" in labels_of(figure) and "failed" not in labels_of(drawn())


def test_collision_is_marked_between_the_closest_robots_that_have_not_vanished():
    trail = np.array([[[120.0, 200.0], [288.0, 206.0], [280.0, 200.0], [289.0, 206.0]]])
    gone = np.array([False, False, False, True])
    moment = snapshot(trail, field=FIELD, failed=gone, gone=gone, collision=True)
    figure = figures.trajectory_figure(moment)
    assert "collision" in labels_of(figure)
    for one in (figure, figures.trajectory_panels({"one": moment})):
        assert marked(one, "s") == [[[284.0, 203.0]]]


def test_empty_rois_are_not_counted():
    own = {"knowledge": "own", "observation": "entities", "sensing_radius": 100.0}
    config = make_config({**own, "empty_rois": (0, 3)})
    moment = play(load_field("field_03"), config, np.zeros((1, 3, 2))).snapshot(1)
    (axes,) = figures.trajectory_panels({"one": moment}).axes
    assert f"{moment.visited.sum()} of 4 ROIs" in axes.get_title(loc="left")
    shown = (draw(one)[:44] for one in (moment, replace(moment, empty=np.False_)))
    assert not np.array_equal(*shown), "the count in the header"


@pytest.mark.parametrize("wind", [(0.3, 0.0), (-0.1, 0.2)])
def test_wind_arrow_points_the_way_the_wind_blows(wind):
    figure = drawn(winds=np.array([wind] * 3))
    (arrow,) = [text for text in figure.axes[0].texts if text.arrow_patch is not None]
    path = arrow.arrow_patch.get_path().vertices
    tail, tip = path[0], path[2]
    direction = (tip - tail) / np.linalg.norm(tip - tail)
    assert direction == pytest.approx(np.array(wind) / np.hypot(*wind), abs=1e-3)
    assert f"wind {np.hypot(*wind):.3g}" in [text.get_text() for text in figure.axes[0].texts]


def test_figure_is_saved_in_the_format_of_its_name_or_not_at_all(tmp_path):
    starts = {".png": b"\x89PNG", ".pdf": b"%PDF", ".svg": b"<?xml"}
    for suffix, magic in starts.items():
        path = figures.save(figures.field_figure(FIELD), tmp_path / "new" / f"field{suffix}")
        written = path.read_bytes()
        assert written.startswith(magic) and b"Date" not in written
        figures.save(figures.field_figure(FIELD), path)
        assert path.read_bytes() == written
    with pytest.raises(MbnError, match=r"field\.txt"):
        figures.save(figures.field_figure(FIELD), tmp_path / "field.txt")


@pytest.mark.slow
def test_figures_leave_matplotlib_as_it_was():
    code = (
        "import sys, matplotlib\n"
        "before = matplotlib.rcParams.copy()\n"
        "from mbn_marl.field import load_field\n"
        "from mbn_marl.render import figures\n"
        "figures.field_figure(load_field('field_03'))\n"
        "assert 'matplotlib.pyplot' not in sys.modules\n"
        "assert matplotlib.rcParams.copy() == before\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


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
def test_colours_of_robots_are_clearly_distinct_for_all_eyes(sight):
    """Distances are 100 times those of OKLab; below 2 two patches side by side look the same."""
    shown = np.array([style.rgb(style.robot_colour(index)) for index in range(10)]) / 255.0
    linear = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
    seen = np.clip(linear @ np.transpose(SIGHTS[sight]), 0.0, 1.0)
    places = 100.0 * np.cbrt(seen @ np.transpose(TO_CONES)) @ np.transpose(TO_LAB)
    apart = np.linalg.norm(places[:, None] - places[None], axis=2)
    assert apart[~np.eye(10, dtype=bool)].min() > (15.0 if sight == "normal" else 8.0)


def test_series_in_a_row_differ_in_colour_dash_and_marker():
    looks = [style.series(index) for index in range(30)]
    for index in range(28):
        for aspect in zip(*looks[index : index + 3], strict=True):
            assert len(set(aspect)) == 3
    assert len({(look.dash, look.marker) for look in looks}) == 30  # so in grey print too
