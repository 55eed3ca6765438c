"""The pages, in a real browser: they load alone, and show what the episode says."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mbn_marl import Field
from mbn_marl.config import make_config
from mbn_marl.episode import Episode
from mbn_marl.errors import MbnError
from mbn_marl.render.web import replay_page
from tests.support.chromium import Chromium, fact

BOX = "getBoundingClientRect()"
FRAMES = """new Promise((done) => {
  let count = 0, first;
  const frame = (now) => {
    first ??= now;
    if (now - first < 1500) { count += 1; requestAnimationFrame(frame); }
    else done(1000 * count / (now - first));
  };
  requestAnimationFrame(frame);
})"""


def made_episode(steps: int, robots: int, source: str) -> Episode:
    """Robots that wander about; nothing here comes from the engine, which the page has not."""
    field = Field(
        [(0, 0), (900, 0), (900, 700), (0, 700)],
        rois=[(100, 600), (450, 350), (800, 100)],
        starts=[(50 + 100 * robot, 50) for robot in range(robots)],
        holes=[[(300, 200), (380, 200), (340, 300)]],
        name="page",
    )
    walk = np.random.default_rng(0).normal(0.0, 2.0, (steps, robots, 2)).cumsum(axis=0)
    positions = np.concatenate([field.starts[None], field.starts + walk]).astype(np.float32)
    terms = np.zeros((steps, robots, 6))
    terms[..., 0] = -10.0
    terms[steps // 2, 0, 3] = 10_000.0
    return Episode(
        field=field,
        config=make_config({"n_robots": robots, "wind": (0.3, 90.0)}),
        actions=np.zeros((steps, robots, 2), np.float32),
        positions=positions,
        headings=np.full((steps + 1, robots), np.nan, np.float32),
        failed=np.zeros(robots, np.int32),
        visits=np.array([steps // 2 + 1, 0, 0], np.int32),
        terms=terms,
        team_rewards=terms.sum(axis=(1, 2)),
        outcome="truncated",
        source=source,
        seed=0,
    )


SHORT, LONG = made_episode(6, 2, "short"), made_episode(40, 3, "<b>long</b> & </script>")


@pytest.fixture
def page(browser: Chromium, tmp_path: Path) -> Chromium:
    """The browser with two episodes."""
    path = tmp_path / "two.html"
    path.write_text(replay_page([SHORT, LONG]), encoding="utf-8")
    browser.size(1200, 900)
    browser.open(path)
    return browser


def scrub(page: Chromium, step: int) -> None:
    """Move the scrub bar as a hand does."""
    page.run(
        f"(() => {{ const bar = document.querySelector('.scrub'); bar.value = {step};"
        "bar.dispatchEvent(new Event('input')); })()"
    )


def robots(page: Chromium, panel: int) -> Any:
    """Where a panel's robots are drawn: (n, 2), in units from the top left corner."""
    return np.array(
        page.run(
            f"[...document.querySelectorAll('.panel')[{panel}].querySelectorAll('.robot')].map("
            "robot => robot.getAttribute('transform').match(/-?\\d[-\\d.e]*/g).map(Number))"
        )
    )


@pytest.mark.all
def test_the_page_loads_alone_and_without_a_word(page: Chromium) -> None:
    assert page.problems == []
    assert page.run("performance.getEntriesByType('resource').length") == 0
    assert page.run("document.querySelectorAll('.panel').length") == 2
    titles = page.run("[...document.querySelectorAll('.panel h2')].map(h => h.textContent)")
    assert titles == ["short", "<b>long</b> & </script>"]
    boxes = "[...document.querySelectorAll('.panel')].map(panel => ['.heading', '.track', '.ticks']"
    boxes += ".map(name => panel.querySelector(name).getBoundingClientRect()))"
    for heading, track, ticks in page.run(f"{boxes}.map(of => of.map(b => [b.top, b.bottom]))"):
        assert (
            heading[1] <= track[0] + 1 and track[1] <= ticks[0] + 1
        )  # the cursor crosses no caption


@pytest.mark.all
def test_the_scrub_bar_moves_the_robots(page: Chromium) -> None:
    before = robots(page, 1)
    for step in (17, 40, 0):
        scrub(page, step)
        moved = robots(page, 1) - before
        expected = (LONG.positions[step] - LONG.positions[0]) * (1, -1)
        assert moved == pytest.approx(expected, abs=1e-3)
        resting = (SHORT.positions[min(step, 6)] - SHORT.positions[0]) * (1, -1)
        assert fact(page, 0, "step") == str(min(step, 6))
        assert robots(page, 0)[0] - before[0] == pytest.approx(resting[0], abs=1e-3)
    assert page.problems == []


@pytest.mark.all
def test_a_robot_that_has_failed_gets_a_cross(browser: Chromium, tmp_path: Path) -> None:
    path = tmp_path / "one.html"
    failed = np.array([0, 4], np.int32)
    path.write_text(replay_page([replace(SHORT, failed=failed)]), encoding="utf-8")
    browser.open(path)
    crossed = "[...document.querySelectorAll('.robot.failed')].map(one => one.dataset.robot)"
    for step, expected in ((3, []), (4, ["1"]), (6, ["1"]), (0, [])):
        scrub(browser, step)
        assert browser.run(crossed) == expected


@pytest.mark.all
def test_robots_with_a_heading_show_it(browser: Chromium, tmp_path: Path) -> None:
    headings = np.stack([np.linspace(0.0, -1.5, 7), np.full(7, np.nan)], axis=1)
    path = tmp_path / "one.html"
    turned = replace(SHORT, headings=headings.astype(np.float32))
    path.write_text(replay_page([turned]), encoding="utf-8")
    browser.open(path)
    noses = "[...document.querySelectorAll('.nose')].map(nose => nose.getAttribute('transform'))"
    assert browser.run(noses) == ["rotate(0)"]
    scrub(browser, 6)
    (turn,) = browser.run(noses)
    assert float(turn[7:-1]) == pytest.approx(np.degrees(1.5), abs=1e-4)  # y down: the other way
    assert browser.problems == []


@pytest.mark.all
def test_gusts_turn_the_arrow(browser: Chromium, tmp_path: Path) -> None:
    winds = np.zeros((7, 2))
    winds[0], winds[4] = (0.3, 0.4), (-0.1, -0.1)
    path = tmp_path / "one.html"
    path.write_text(replay_page([replace(SHORT, winds=winds)]), encoding="utf-8")
    browser.open(path)
    wind = "[document.querySelector('.wind').textContent,"
    wind += "document.querySelector('.wind path').getAttribute('transform')]"
    for step, expected in (
        (0, ["wind 0.5 at 53\u00b0", "rotate(-53)"]),
        (4, ["wind 0.14 at \u2212135\u00b0", "rotate(135)"]),
        (5, ["wind 0 at 0\u00b0", "rotate(0)"]),
        (0, ["wind 0.5 at 53\u00b0", "rotate(-53)"]),
    ):
        scrub(browser, step)
        assert browser.run(wind) == expected
    assert browser.problems == []


@pytest.mark.all
def test_rois_returns_and_cursor_follow(page: Chromium) -> None:
    visited = "document.querySelectorAll('.panel')[1].querySelectorAll('.roi.visited').length"
    cursor = "document.querySelectorAll('.panel')[1].querySelector('.cursor').style.transform"
    scrub(page, 20)
    assert (fact(page, 1, "ROIs"), page.run(visited)) == ("0/3", 0)
    assert page.run(cursor) == "translateX(50%)"
    scrub(page, 21)
    assert (fact(page, 1, "ROIs"), page.run(visited)) == ("1/3", 1)
    assert fact(page, 1, "return") == "9,370"  # 10 000 less 21 steps of three robots
    rows = page.run(
        "[...document.querySelectorAll('.panel')[1].querySelectorAll('.term .label')]"
        ".map(label => [label.textContent, label.parentElement.querySelector('output').value])"
    )
    assert rows == [["return", "9,370"], ["step", "\u2212630"], ["roi", "10,000"]]


@pytest.mark.all
def test_strips_have_scales_and_units(page: Chromium) -> None:
    """40 steps of three robots cost 10 each; the ROI of step 21 earns 10 000."""
    strips = "document.querySelectorAll('.panel')[1].querySelectorAll"
    scales = page.run(
        f"[...{strips}('.scale')].map(scale => [...scale.children].map(end => end.textContent))"
    )
    assert scales == [["9.37K", "\u2212600"], ["0", "\u22121.2K"], ["10K", "0"]]
    ticks = page.run(f"[...{strips}('.ticks span')].map(tick => [tick.innerText, tick.style.left])")
    assert ticks == [[str(step), f"{2.5 * step:g}%"] for step in (0, 10, 20, 30, 40)]
    words = page.run(f"[...{strips}('.heading, .unit')].map(one => one.textContent)")
    assert words == ["running total of the reward", "steps"]


@pytest.mark.all
def test_names_of_rois_lie_above_the_robots(page: Chromium) -> None:
    above = page.run(
        "[...document.querySelectorAll('.panel')[1].querySelectorAll('.name')].map(name => "
        "[...document.querySelectorAll('.panel')[1].querySelectorAll('.robot')].every(robot => "
        "robot.compareDocumentPosition(name) & Node.DOCUMENT_POSITION_FOLLOWING))"
    )
    assert above == [True] * 3
    assert page.run("getComputedStyle(document.querySelector('.name')).paintOrder") == "stroke"


@pytest.mark.all
def test_keys_drive_the_player(page: Chromium) -> None:
    at = "document.querySelector('.counter').textContent"
    for key, shift, expected in (
        ("End", False, "40 / 40"),
        ("ArrowLeft", False, "39 / 40"),
        ("ArrowLeft", True, "29 / 40"),
        ("ArrowRight", False, "30 / 40"),
        ("Home", False, "0 / 40"),
        ("ArrowLeft", False, "0 / 40"),
    ):
        page.press(key, shift=shift)
        assert page.run(at) == expected, key
    speed = page.run("document.querySelector('select').value")
    page.press("+")
    assert float(page.run("document.querySelector('select').value")) > float(speed)
    page.press(" ")
    page.wait_for(f"parseInt({at}) > 3")
    page.press(" ")
    assert page.run("document.querySelector('.play').getAttribute('aria-label')") == "play"
    stopped = page.run(at)
    assert page.run(f"new Promise(done => setTimeout(() => done({at}), 200))") == stopped


@pytest.mark.all
def test_playing_ends_at_the_end_and_begins_again(page: Chromium) -> None:
    page.run("document.querySelector('select').value = 500")
    page.press(" ")
    page.wait_for("document.querySelector('.counter').textContent === '40 / 40'")
    label = "document.querySelector('.play').getAttribute('aria-label')"
    page.wait_for(f"{label} === 'play'")
    page.run("document.querySelector('select').value = 1")
    page.run("document.querySelector('.play').click()")
    assert page.run("document.querySelector('.counter').textContent") == "0 / 40"
    assert page.run(label) == "pause"
    page.press("k")


@pytest.mark.all
def test_a_phone_and_the_dark(page: Chromium, tmp_path: Path) -> None:
    colour = "getComputedStyle(document.documentElement).backgroundColor"
    light = page.run(colour)
    page.size(390, 844, dark=True, phone=True)
    assert page.run(colour) != light
    page.wait_for("document.documentElement.scrollWidth <= 390")
    box = page.run(
        "(({width, bottom}) => [width, bottom])"
        "(document.querySelector('.controls').getBoundingClientRect())"
    )
    assert box[0] <= 390 and box[1] <= 845, "the controls stay on the screen"
    drawn = (
        "(canvas => canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height)"
        ".data.some(value => value))(document.querySelectorAll('canvas')[1])"
    )
    scrub(page, 40)
    page.wait_for(drawn)


@pytest.mark.all
def test_a_long_episode_is_small_quick_and_smooth(browser: Chromium, tmp_path: Path) -> None:
    """The bounds are looser than the targets, for busy machines; docs/replay.md has the figures."""
    path = tmp_path / "long.html"
    path.write_text(replay_page([made_episode(1000, 7, "long")]), encoding="utf-8")
    assert path.stat().st_size < 300_000
    browser.size(1200, 900)
    browser.open(path)
    paint = "performance.getEntriesByName('first-contentful-paint')[0].startTime"
    assert browser.run(paint) < 3000.0
    browser.press(" ")
    assert browser.run(FRAMES) > 20.0
    assert browser.problems == []


def test_a_page_holds_its_episodes() -> None:
    with pytest.raises(MbnError, match="episode"):
        replay_page([])
    pages = [replay_page([one]) for one in (SHORT, replace(SHORT, outcome="collision"), LONG)]
    assert len(set(pages)) == 3
    assert not re.search("(src|href)=.https?:", pages[0]), "it loads nothing"
    assert "<b>long" not in pages[2] and pages[2].count("</script>") == pages[0].count("</script>")
