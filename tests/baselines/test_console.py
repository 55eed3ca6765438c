"""A pipe gets tables in their natural width, a terminal in its own; no cell is cut."""

import sys

import pytest

from baselines.compare.text_table import TextTable
from tests.support.terminal import in_terminal

LABELS = [f"a-rather-long-label-{k}" for k in range(8)]
PRINT = f"""
from baselines.compare.text_table import TextTable
TextTable("", {LABELS}, [["-1,972,196"] * 8]).print("title")
"""


@pytest.mark.parametrize(("columns", "fits"), [("", False), ("80", True)])
def test_width(
    columns: str, fits: bool, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    TextTable("", LABELS, [["-1,972,196"] * 8]).print("title")
    printed = capsys.readouterr().out
    assert (max(map(len, printed.splitlines())) <= 80) == fits
    assert sum(map(str.isdigit, printed)) == 8 * 8, "a digit a label, seven a number"


@pytest.mark.all
def test_terminal_keeps_its_width() -> None:
    printed = in_terminal([sys.executable, "-c", PRINT], columns=50)
    assert max(map(len, printed.splitlines())) <= 50 and "…" not in printed
