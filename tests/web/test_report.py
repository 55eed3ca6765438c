"""The report: one page with everything, refused before the work if it cannot be."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from baselines.cli import main
from baselines.policies.load import ENTRIES
from tests.support.chromium import Chromium, fact


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two finished runs of one algorithm, with the zoo's policy and made-up evaluations."""
    folder = tmp_path_factory.mktemp("runs")
    entry = ENTRIES / "field_03"
    card = json.loads((entry / "card.json").read_text())
    for seed in (0, 1):
        run = folder / f"run{seed}"
        shutil.copytree(entry, run)
        config = json.loads((run / "config.json").read_text())
        (run / "config.json").write_text(json.dumps({**config, "seed": seed}))
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


@pytest.mark.all
def test_the_report_is_one_page_with_everything(
    runs: Path, browser: Chromium, tmp_path: Path
) -> None:
    out = tmp_path / "report.html"
    assert main(["report", str(runs), "-o", str(out)]) == 0
    browser.size(1200, 900)
    browser.open(out)
    assert browser.problems == []
    assert browser.run("performance.getEntriesByType('resource').length") == 0
    text = browser.run("document.body.textContent")
    assert f"mbn report {runs} -o {out}" in text and "mbn train --seed 1 <field>" in text
    pictures = browser.run("[...document.images].map(one => [one.alt, one.naturalWidth > 100])")
    assert ["Performance profiles", True] in pictures and all(shown for _, shown in pictures)
    browser.press("End")
    assert fact(browser, 0, "ROIs") == "0/6", "keys are the page's until a player is touched"
    browser.run("document.querySelector('[data-replay] .scrub').focus()")
    browser.press("End")
    assert fact(browser, 0, "ROIs") == fact(browser, 1, "ROIs") == "6/6"


@pytest.mark.slow
def test_a_report_is_written_or_refused_before_the_work(
    runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, new = tmp_path / "report.html", str(tmp_path / "new.html")
    assert main(["report", str(runs), "-o", str(out)]) == 0
    page = out.read_text(encoding="utf-8")
    for expected in ("Performance profiles", "Learning curves on field_03", "best: run0"):
        assert expected in page, expected
    capsys.readouterr()
    assert main(["report", str(runs), "-o", str(out)]) == 2
    assert "report.html" in capsys.readouterr().err and out.read_text("utf-8") == page
    assert main(["report", str(runs), "--paper", "-o", new]) == 2
    assert main(["report", str(runs), "-o", str(tmp_path / "folder")]) == 2
    assert not Path(new).exists()
