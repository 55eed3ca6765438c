"""The pages, in a real browser: they load alone, and show what the episode says."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from baselines.cli import main
from mbn_marl import Field, load_field
from mbn_marl.config import make_config
from mbn_marl.episode import Episode, load_episode, play, save_episode
from mbn_marl.errors import MbnError
from mbn_marl.web.replay import replay_page
from tests.support.chromium import MISSING, PROGRAM, Chromium

needs_browser = pytest.mark.skipif(PROGRAM is None, reason=MISSING)
FRAMES = """new Promise((done) => {
  let count = 0, first;
  const frame = (now) => {
    first ??= now;
    if (now - first < 1500) { count += 1; requestAnimationFrame(frame); }
    else done(1000 * count / (now - first));
  };
  requestAnimationFrame(frame);
})"""


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chromium]:
    """One browser for all tests."""
    with Chromium(tmp_path_factory.mktemp("chromium")) as running:
        yield running


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


def fact(page: Chromium, panel: int, name: str) -> str:
    """A number above a panel."""
    found: str = page.run(
        f"document.querySelectorAll('.panel')[{panel}]"
        f".querySelector('[data-fact=\"{name}\"]').textContent"
    )
    return found


@needs_browser
def test_the_page_loads_alone_and_without_a_word(page: Chromium) -> None:
    assert page.problems == []
    assert page.run("performance.getEntriesByType('resource').length") == 0
    assert page.run("document.querySelectorAll('.panel').length") == 2
    titles = page.run("[...document.querySelectorAll('.panel h2')].map(h => h.textContent)")
    assert titles == ["short", "<b>long</b> & </script>"]


@needs_browser
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


@needs_browser
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
        "[...document.querySelectorAll('.panel')[1].querySelectorAll('.term')]"
        ".map(row => row.innerText.replace(/\\s+/g, ' ').trim())"
    )
    assert rows == ["return 9,370", "step \u2212630", "roi 10,000"]


@needs_browser
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


@needs_browser
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


@needs_browser
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


@needs_browser
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


def test_no_episode_is_an_error() -> None:
    with pytest.raises(MbnError, match="at least one episode"):
        replay_page([])


# ---------------------------------------------------------------- commands


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An episode's file, of the zoo's policy."""
    path = tmp_path_factory.mktemp("episodes") / "learned.json"
    assert main(["render", "zoo:field_03", "-o", str(path)]) == 0
    return path


def test_an_episode_of_the_zoo(recorded: Path) -> None:
    episode = load_episode(recorded)
    assert (episode.outcome, episode.source, episode.seed) == ("success", "zoo:field_03", 0)
    assert episode.field == load_field("field_03") and episode.rois_visited == 6


def test_replay_writes_a_page_and_nothing_over_another(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = save_episode(
        play(load_field("field_03"), make_config({}), np.zeros((3, 3, 2)), source="waiting"),
        tmp_path / "waiting.json",
    )
    out = tmp_path / "page.html"
    assert main(["replay", str(recorded), str(other), "-o", str(out)]) == 0
    assert "zoo:field_03: success" in capsys.readouterr().out
    text = out.read_text()
    assert "waiting" in text and "://" not in text.replace("http://www.w3.org/2000/svg", "")
    assert main(["replay", str(other), "-o", str(out)]) == 2
    assert "page.html already exists" in capsys.readouterr().err
    assert out.read_text() == text
    assert main(["replay", str(other), "-o", str(out), "--force"]) == 0
    assert (tmp_path / "page.html.1").read_text() == text


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (lambda text: text[:500], "not JSON, or cut off"),
        (lambda text: '{"format": "other"}', "format: 'other'; expected an episode"),
        (lambda text: text.replace("episode/1", "episode/9", 1), "'mbn-episode/9'; expected"),
        (lambda text: text.replace('"tau":1.0', '"tau":2.0'), "checksum: not that of"),
        (
            lambda text: re.sub(
                '"checksum":".*"', '"checksum":null', text.replace('"tau":1.0', '"tau":2.0')
            ),
            "it does not replay",
        ),
    ],
    ids=["cut off", "foreign", "version", "tampered", "tampered with care"],
)
def test_replay_says_what_is_wrong_with_a_file(
    content: Any,
    message: str,
    recorded: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    bad, out = tmp_path / "bad.json", tmp_path / "page.html"
    bad.write_text(content(recorded.read_text()))
    assert main(["replay", str(recorded), str(bad), "-o", str(out)]) == 2
    error = capsys.readouterr().err
    assert str(bad) in error and message in error
    assert not out.exists()


def test_render_shows_a_recorded_episode(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, start in (("a.gif", b"GIF89a"), ("a.pdf", b"%PDF"), ("a.svg", b"<?xml")):
        assert main(["render", str(recorded), "-o", str(tmp_path / name)]) == 0
        assert (tmp_path / name).read_bytes().startswith(start)
    film = tmp_path / "a.mp4"
    assert main(["render", str(recorded), "-o", str(film)]) == 0
    assert film.read_bytes()[4:8] == b"ftyp"
    assert main(["render", str(recorded), "-o", str(film)]) == 2
    assert "a.mp4 already exists" in capsys.readouterr().err
    assert main(["render", str(recorded), "--steps", "3", "-o", str(tmp_path / "b.gif")]) == 2
    assert "which is recorded already" in capsys.readouterr().err
    sorted_names, foreign = tmp_path / "sorted.json", tmp_path / "foreign.json"
    sorted_names.write_text(json.dumps(json.loads(recorded.read_text()), sort_keys=True))
    assert main(["render", str(sorted_names), "-o", str(tmp_path / "b.svg")]) == 0
    foreign.write_text('{"type": "other"}')
    assert main(["render", str(foreign), "-o", str(tmp_path / "b.gif")]) == 2
    error = capsys.readouterr().err
    assert "foreign.json" in error and "mbn-field/1" in error and "mbn-episode/1" in error
    assert not (tmp_path / "b.gif").exists()


def test_evaluate_records_its_best_median_and_worst(tmp_path: Path) -> None:
    out, results = tmp_path / "episodes", tmp_path / "results.json"
    command = ["evaluate", "zoo:field_07", "--episodes", "5", "--record", str(out)]
    assert main([*command, "--json", str(results)]) == 0
    returns = sorted(json.loads(results.read_text())["stochastic"]["per_episode"]["returns"])
    found = [load_episode(out / f"{name}.json") for name in ("worst", "median", "best")]
    assert [one.team_return for one in found] == [returns[0], returns[2], returns[4]]
    assert main(command) == 2, "the folder is there already"


def test_fields_are_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "fields.pdf"
    assert main(["fields", "field_03", "field_05", "--figure", str(out)]) == 0
    assert "field_05" in capsys.readouterr().out and out.read_bytes().startswith(b"%PDF")
    assert main(["fields", "--figure", str(out)]) == 2


# ---------------------------------------------------------------- the report


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two finished runs of one algorithm, with the zoo's policy and made-up evaluations."""
    from baselines.zoo.entries import FOLDER

    folder = tmp_path_factory.mktemp("runs")
    entry = FOLDER / "field_03"
    card = json.loads((entry / "card.json").read_text())
    for seed in (0, 1):
        run = folder / f"run{seed}"
        shutil.copytree(entry, run)
        config = json.loads((run / "config.json").read_text())
        (run / "config.json").write_text(json.dumps({**config, "seed": seed}))
        (run / "checksums.json").unlink()
        (run / "command.txt").write_text(f"mbn train --seed {seed} <field>\n")
        evaluation = {name: card[name] for name in ("stochastic", "deterministic")}
        evaluation |= {"env_steps": 4096, "seconds": 2.0}
        history = [
            {"env_steps": 2048 * count, "seconds": count, "return_mean": 7e4 * count + seed}
            for count in (1, 2)
        ]
        (run / "evaluation.json").write_text(json.dumps(evaluation))
        (run / "evaluations.json").write_text(json.dumps(history))
    return folder


@needs_browser
def test_the_report_is_one_page_with_everything(
    runs: Path, browser: Chromium, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "report.html"
    assert main(["report", str(runs), "-o", str(out)]) == 0
    browser.size(1200, 900)
    browser.open(out)
    assert browser.problems == []
    assert browser.run("performance.getEntriesByType('resource').length") == 0
    text = browser.run("document.body.textContent")
    for expected in (
        "Optimality gap per field",
        "best: run0",
        "median: run1",
        f"mbn report {runs} -o {out}",
        "mbn train --seed 1 <field>",
    ):
        assert expected in text, expected
    pictures = browser.run("[...document.images].map(one => [one.alt, one.naturalWidth > 100])")
    assert ["Performance profiles", True] in pictures
    assert ["Learning curves on field_03", True] in pictures
    assert all(loaded for _, loaded in pictures)
    links = browser.run(
        "[...document.querySelectorAll('nav a')].every("
        "one => document.querySelector(one.getAttribute('href')))"
    )
    assert links and browser.run("document.querySelector('[data-replay] .panel') !== null")
    browser.press("End")
    assert fact(browser, 0, "ROIs") == "0/6", "keys are the page's until a player is touched"
    browser.run("document.querySelector('[data-replay] .scrub').focus()")
    browser.press("End")
    assert fact(browser, 0, "ROIs") == fact(browser, 1, "ROIs") == "6/6"
    browser.size(390, 844, phone=True)
    browser.wait_for("document.documentElement.scrollWidth <= 390")


def test_a_report_is_refused_before_the_work(
    runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "report.html"
    out.write_text("mine")
    assert main(["report", str(runs), "-o", str(out)]) == 2
    assert "report.html already exists" in capsys.readouterr().err and out.read_text() == "mine"
    unfinished = tmp_path / "unfinished"
    shutil.copytree(runs / "run0", unfinished)
    (unfinished / "evaluations.json").unlink()
    assert main(["report", str(unfinished), "-o", str(tmp_path / "new.html")]) == 2
    error = capsys.readouterr().err
    assert "unfinished/evaluations.json is missing" in error
    (unfinished / "evaluations.json").write_text("[]")
    assert main(["report", str(unfinished), "-o", str(tmp_path / "new.html")]) == 2
    assert "evaluations.json is empty" in capsys.readouterr().err
    for text, message in (
        ('[{"env_steps": 1, "seconds": 1.0}]', "evaluations.json has no return_mean"),
        ("[7]", "evaluations.json has no env_steps"),
        ("\udc80", "evaluations.json is not valid JSON"),
    ):
        (unfinished / "evaluations.json").write_text(text, "utf-8", "surrogateescape")
        assert main(["report", str(unfinished), "-o", str(tmp_path / "new.html")]) == 2
        assert message in capsys.readouterr().err
    (unfinished / "evaluations.json").write_text("[]")
    (unfinished / "config.json").write_text('{"algorithm": "ppo"}')
    assert main(["report", str(unfinished), "-o", str(tmp_path / "new.html")]) == 2
    assert "config.json has no setting, seed" in capsys.readouterr().err
    assert main(["report", str(runs), "--paper", "-o", str(tmp_path / "new.html")]) == 2
    assert main(["report", str(runs), "-o", str(tmp_path / "folder")]) == 2
    assert not (tmp_path / "new.html").exists()


def test_episodes_that_differ_make_different_pages() -> None:
    assert replay_page([SHORT]) != replay_page([replace(SHORT, outcome="collision")])
