"""Pictures: their parts and places."""

import numpy as np
import pytest

from mbn_marl.field import Field
from mbn_marl.render import Viewer, style
from tests.support.pictures import FIELD, HOLE, SIZE, SQUARE, draw, snapshot, wander, where


@pytest.mark.parametrize("position", [(200.0, 290.0), (200.0, 110.0), (285.0, 240.0)])
def test_robot_is_drawn_where_it_is_with_y_up_and_holes_are_obstacles(position):
    field = Field(SQUARE, rois=FIELD.rois, starts=FIELD.starts, holes=[HOLE])
    frame = draw(snapshot([position], roi_radius=0.0, field=field))
    ground_rows, ground_columns = where(frame, style.GROUND)
    rows, columns = where(frame, style.robot_colour(0))
    left, right = ground_columns.min(), ground_columns.max()
    top, bottom = ground_rows.min(), ground_rows.max()
    share = (np.array(position) - 100.0) / 200.0
    assert np.median(columns) == pytest.approx(left + share[0] * (right - left), abs=3.0)
    assert np.median(rows) == pytest.approx(bottom - share[1] * (bottom - top), abs=3.0)
    middle = (top + bottom) // 2, (left + right) // 2
    assert tuple(frame[middle]) == style.rgb(style.OBSTACLE)


@pytest.mark.parametrize("heading", [0.0, 0.5 * np.pi, 2.5])
def test_point_shows_where_a_robot_faces_and_a_cross_a_failure(heading):
    alone = {"trail": [(200.0, 200.0)], "roi_radius": 0.0, "safety_distance": 0.0}
    plain, faced, failed = (
        draw(snapshot(**alone, **changes))
        for changes in ({}, {"headings": np.array([heading])}, {"failed": np.array([True])})
    )
    colour = style.robot_colour(0)
    disc, both = (set(zip(*where(one, colour), strict=True)) for one in (plain, faced))
    row, column = np.mean(list(both - disc), axis=0) - np.mean(list(disc), axis=0)
    assert np.arctan2(-row, column) == pytest.approx(heading, abs=0.15)
    crossed = np.nonzero((plain != failed).any(axis=2))
    for rows, changed in zip(where(plain, colour), crossed, strict=True):
        assert np.median(changed) == pytest.approx(np.median(rows), abs=1.5)
    assert (failed[crossed] == style.rgb(style.INK)).all(axis=1).sum() > 20


def test_visited_roi_is_filled_and_an_open_one_hollow():
    none, first = (draw(snapshot(visited=np.array(seen))) for seen in ([0, 0], [1, 0]))
    assert not where(none, style.ROI_VISITED)[0].size
    rows, columns = where(first, style.ROI_VISITED)
    assert rows.size > 50
    assert rows.min() > 250 and columns.max() < 150, "the first ROI is at the lower left"


@pytest.mark.parametrize(("wind", "towards"), [((0.3, 0.0), (0, 1)), ((0.0, 0.3), (-1, 0))])
def test_wind_arrow_points_the_way_the_wind_blows(wind, towards):
    corner = draw(snapshot(winds=np.array([wind])))[:44, -42:]
    mass = 255.0 - corner[:, :, 0]
    mass[(corner == style.rgb(style.OBSTACLE)).all(axis=2)] = 0.0
    rows, columns = np.indices(mass.shape)
    middle = np.array([22.5, 18.5])
    inside = np.hypot(rows - middle[0], columns - middle[1]) < 15.0
    weight = mass[inside] / mass[inside].sum()
    offset = np.array([rows[inside] @ weight, columns[inside] @ weight]) - middle
    assert offset @ towards > 1.5, "the head of the arrow is its heavy end"
    assert abs(offset @ towards[::-1]) < 0.5


@pytest.mark.parametrize(
    ("ending", "colour"), [("success", style.SUCCESS), ("collision", style.COLLISION)]
)
def test_end_of_an_episode_is_announced(ending, colour):
    running, over = draw(snapshot()), draw(snapshot(**{ending: True}))
    assert not where(running[:44], colour)[0].size
    assert where(over[:44], colour)[0].size > 100


def test_users_robot_is_ringed():
    moment = snapshot([[(130.0, 200.0), (270.0, 200.0)]], safety_distance=0.0, roi_radius=0.0)
    plain, ours = (draw(moment, Viewer("rgb_array", SIZE, own=own)) for own in (None, 1))
    rows, columns = np.nonzero((plain != ours).any(axis=2))
    place = [np.median(axis) for axis in where(plain, style.robot_colour(1))]
    assert [rows.mean(), columns.mean()] == pytest.approx(place, abs=1.5)
    assert 20 <= np.ptp(columns) <= 30, "a ring round a disc of 16 pixels"


def test_trail_drawn_bit_by_bit_is_the_trail_drawn_at_once():
    trail, viewer = wander(40, 3), Viewer("rgb_array", SIZE)
    frames = [draw(snapshot(trail[: step + 1]), viewer) for step in range(41)]
    assert np.array_equal(frames[-1], draw(snapshot(trail)))
    assert not np.array_equal(frames[-1], draw(snapshot(trail[-1:], step=40, team_return=-400.0)))


@pytest.mark.parametrize(
    "other",
    [
        snapshot(wander(5, 3, seed=1)),
        snapshot(wander(30, 3, seed=1)),
        snapshot(wander(20, 3), winds=np.array([(0.1, 0.0)])),
        snapshot(
            wander(20, 3),
            field=Field([(90, 90), (320, 90), (270, 320)], rois=FIELD.rois, starts=[(120, 100)]),
        ),
    ],
    ids=["a shorter episode", "a longer episode", "wind", "another field"],
)
def test_nothing_of_the_last_frame_stays(other):
    viewer = Viewer("rgb_array", SIZE)
    draw(snapshot(wander(20, 3)), viewer)
    assert np.array_equal(draw(other, viewer), draw(other))
