"""The pages, in a real browser: they load alone, and show what episodes and runs say."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from baselines.cli import main
from baselines.policies.load import ENTRIES
from mbn_marl import Field
from mbn_marl.config import make_config
from mbn_marl.episode import Episode, Knowledge
from mbn_marl.errors import MbnError
from mbn_marl.render.web import replay_page
from tests.support.chromium import MISSING, PROGRAM, Chromium, fact
from tests.support.records import make_run


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    if PROGRAM is None:
        pytest.skip(MISSING)
    with Chromium(tmp_path_factory.mktemp("chromium")) as running:
        yield running


PANEL = "document.querySelectorAll('.panel')[1].querySelectorAll"
COUNTER = "document.querySelector('.counter').textContent"
LABEL = "document.querySelector('.play').getAttribute('aria-label')"


def made_episode(steps: int, robots: int, source: str) -> Episode:
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


def opened(browser: Chromium, folder: Path, *episodes: Episode) -> Chromium:
    path = folder / "page.html"
    path.write_text(replay_page(episodes), encoding="utf-8")
    browser.size(1200, 900)
    browser.open(path)
    return browser


@pytest.fixture
def page(browser, tmp_path):
    return opened(browser, tmp_path, SHORT, LONG)


def scrub(page: Chromium, step: int) -> None:
    page.run(
        f"(() => {{ const bar = document.querySelector('.scrub'); bar.value = {step};"
        "bar.dispatchEvent(new Event('input')); })()"
    )


def each(page: Chromium, parts: str, value: str) -> Any:
    """The values of an expression of ``one`` for all parts of the second panel."""
    return page.run(f"[...{PANEL}('{parts}')].map(one => {value})")


def robots(page: Chromium, panel: int) -> Any:
    """Return (n, 2): where a panel's robots are drawn, units from the top left corner."""
    return np.array(
        page.run(
            f"[...document.querySelectorAll('.panel')[{panel}].querySelectorAll('.robot')].map("
            "robot => robot.getAttribute('transform').match(/-?\\d[-\\d.e]*/g).map(Number))"
        )
    )


@pytest.mark.all
def test_page_loads_alone_and_moves_its_robots(page):
    assert page.run("performance.getEntriesByType('resource').length") == 0
    titles = page.run("[...document.querySelectorAll('.panel h2')].map(h => h.textContent)")
    assert titles == ["short", "<b>long</b> & </script>"]
    before = robots(page, 1)
    for step in (17, 40):
        scrub(page, step)
        moved = robots(page, 1) - before
        expected = (LONG.positions[step] - LONG.positions[0]) * (1, -1)
        assert moved == pytest.approx(expected, abs=1e-3)
        assert fact(page, 0, "step") == "6"
    assert page.problems == []


TURNED = np.stack([np.linspace(0.0, -1.5, 7), np.full(7, np.nan)], axis=1).astype(np.float32)
WINDS = np.zeros((7, 2))
WINDS[0], WINDS[4] = (0.3, 0.4), (-0.1, -0.1)


@pytest.mark.all
def test_failures_headings_and_gusts_are_shown(browser, tmp_path):
    disturbed = replace(SHORT, failed=np.array([0, 4], np.int32), headings=TURNED, winds=WINDS)
    page = opened(browser, tmp_path, LONG, disturbed)
    turned = "one.getAttribute('transform').replace(/\\.\\d+/, '')"
    wind = "one.textContent + one.querySelector('path').getAttribute('transform')"
    for step, failed, angle, text in (  # y is down: noses and winds turn the other way
        (4, ["1"], 57, "wind 0.14 at \u2212135\u00b0rotate(135)"),
        (6, ["1"], 85, "wind 0 at 0\u00b0rotate(0)"),
        (0, [], 0, "wind 0.5 at 53\u00b0rotate(-53)"),
    ):
        scrub(page, step)
        assert each(page, ".robot.failed", "one.dataset.robot") == failed
        assert each(page, ".nose", turned) == [f"rotate({angle})"]
        assert each(page, ".wind", wind) == [text]
    assert page.problems == []


# Robot 0 hears robot 1 in step 2, and robot 1 hears nothing.
HEARD = np.zeros((7, 2, 2), np.bool_)
HEARD[2, 0, 1] = True
DONE, FOUND = np.array([[5, 7, 7], [7, 2, 7]]), np.array([[0, 3, 7], [0, 0, 0]])
KNOWN = Knowledge(np.array([False, True, False]), DONE, FOUND, HEARD)


@pytest.mark.all
def test_what_each_robot_knows_and_hears_is_shown(browser, tmp_path):
    page = opened(browser, tmp_path, LONG, replace(SHORT, knowledge=KNOWN))
    look = "['visited', 'empty', 'unfound'].filter(name => one.classList.contains(name)).join()"
    ends = "(one.getAttribute('d') || '').match(/-?\\d[-\\d.e]*/g)"
    assert page.run("document.querySelectorAll('.views').length") == 1
    scrub(page, 2)
    for expected in (["", "empty", ""], ["", "unfound", "unfound"], ["", "visited", ""]):
        assert each(page, ".roi", look) == each(page, ".stage .label", look) == expected
        page.press("r")
    mine, other = robots(page, 1)
    (line,) = each(page, ".links", ends)
    np.testing.assert_allclose(np.array(line, float), [*mine, *(mine + other) / 2], 1e-6)
    page.press("t")
    assert each(page, ".links", ends) == [None]
    for robot, chosen in ((".robot", ["0"]), (".stage", [])):
        page.run(f"{PANEL}('{robot}')[0].dispatchEvent(new Event('click', {{bubbles: true}}))")
        assert each(page, ".viewer", "one.dataset.robot") == chosen
    scrub(page, 6)
    assert each(page, ".roi", look) == ["visited", "empty", ""] and fact(page, 1, "ROIs") == "1/2"
    assert page.problems == []


@pytest.mark.all
def test_rois_returns_cursor_and_scales_are_right(page):
    """40 steps of three robots cost 10 each; the ROI of step 21 earns 10 000."""
    for step, visited in ((20, 0), (21, 1)):
        scrub(page, step)
        assert fact(page, 1, "ROIs") == f"{visited}/3"
        assert len(each(page, ".roi.visited", "1")) == visited
        assert each(page, ".cursor", "one.style.transform")[0] == f"translateX({2.5 * step:g}%)"
    assert fact(page, 1, "return") == "9,370"
    row = "[one.textContent, one.parentElement.querySelector('output').value]"
    rows = [["return", "9,370"], ["step", "\u2212630"], ["roi", "10,000"]]
    assert each(page, ".term .label", row) == rows
    scales = each(page, ".scale", "[...one.children].map(end => end.textContent)")
    assert scales == [["9.37K", "\u2212600"], ["0", "\u22121.2K"], ["10K", "0"]]


@pytest.mark.all
def test_keys_drive_the_player_to_its_end_and_back(page):
    for key, shift, expected in (
        ("End", False, "40 / 40"),
        ("ArrowLeft", True, "30 / 40"),
        ("ArrowRight", False, "31 / 40"),
        ("Home", False, "0 / 40"),
    ):
        page.press(key, shift=shift)
        assert page.run(COUNTER) == expected, key
    speed = page.run("document.querySelector('select').value")
    page.press("+")
    assert float(page.run("document.querySelector('select').value")) > float(speed)
    page.press(" ")
    page.wait_for(f"parseInt({COUNTER}) > 3")
    page.press(" ")
    assert page.run(LABEL) == "play"
    page.run("document.querySelector('select').value = 500")
    page.press(" ")
    page.wait_for(f"{COUNTER} === '40 / 40'")
    page.wait_for(f"{LABEL} === 'play'")


@pytest.mark.all
def test_phone_and_the_dark(page):
    colour = "getComputedStyle(document.documentElement).backgroundColor"
    light = page.run(colour)
    page.size(390, 844, dark=True, phone=True)
    assert page.run(colour) != light
    page.wait_for("document.documentElement.scrollWidth <= 390")
    box = page.run("document.querySelector('.controls').getBoundingClientRect().toJSON()")
    assert box["width"] <= 390 and box["bottom"] <= 845, "the controls stay on the screen"


def test_page_holds_its_episodes():
    with pytest.raises(MbnError, match="episode"):
        replay_page([])
    short, long = replay_page([SHORT]), replay_page([LONG])
    assert not re.search("(src|href)=.https?:", short), "it loads nothing"
    assert "<b>long" not in long and long.count("</script>") == short.count("</script>")


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two finished runs of one algorithm, with the zoo's policy and made-up evaluations."""
    folder, entry = tmp_path_factory.mktemp("runs"), ENTRIES / "field_03"
    config = json.loads((entry / "config.json").read_text())
    learner = {name: config[name] for name in ("algorithm", "environment", "hyperparameters")}
    for seed in (0, 1):
        run = make_run(folder, 0.9, seed=seed, **learner).run
        shutil.copytree(entry / "policy", run.path / "policy")
        (run.path / "command.txt").write_text(f"mbn train --seed {seed} <field>\n")
    return folder


@pytest.mark.all
def test_the_report_is_one_page_with_everything(runs, browser, tmp_path):
    out = tmp_path / "report.html"
    assert main(["report", str(runs), "-o", str(out)]) == 0
    browser.size(1200, 900)
    browser.open(out)
    assert browser.problems == []
    assert browser.run("performance.getEntriesByType('resource').length") == 0
    text = browser.run("document.body.textContent")
    assert f"mbn report {runs} -o {out}" in text and "mbn train --seed 1 <field>" in text
    pictures = browser.run("[...document.images].map(one => [one.alt, one.naturalWidth > 100])")
    assert ["Makespan gaps", True] in pictures and all(shown for _, shown in pictures)
    browser.press("End")
    assert fact(browser, 0, "ROIs") == "0/6", "keys are the page's until a player is touched"
    browser.run("document.querySelector('[data-replay] .scrub').focus()")
    browser.press("End")
    assert fact(browser, 0, "ROIs") == fact(browser, 1, "ROIs") == "6/6"


@pytest.mark.slow
def test_a_report_is_written_or_refused_before_the_work(runs, tmp_path, capsys):
    out, new = tmp_path / "report.html", str(tmp_path / "new.html")
    assert main(["report", str(runs), "-o", str(out)]) == 0
    page = out.read_text(encoding="utf-8")
    for expected in ("Makespan gaps", "Learning curves on field_03", "best: mappo-field_03-0-0"):
        assert expected in page, expected
    capsys.readouterr()
    assert main(["report", str(runs), "-o", str(out)]) == 2
    assert "report.html" in capsys.readouterr().err and out.read_text("utf-8") == page
    assert main(["report", str(runs), "--paper", "-o", new]) == 2
    assert main(["report", str(runs), "-o", str(tmp_path / "folder")]) == 2
    assert not Path(new).exists()
