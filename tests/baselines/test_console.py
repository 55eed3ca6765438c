"""A pipe gets tables in their natural width; a terminal gets them in blocks, no cell broken."""

import sys

import pytest

from baselines.compare.text_table import TextTable
from tests.support.terminal import in_terminal

HEADINGS, LINE = ["algorithm", "setting", "one", "two", "three"], ["ppo", "N", *["-11,972,196"] * 3]
PRINT = f"""
from baselines.compare.text_table import TextTable
TextTable("the caption", {HEADINGS}, [{LINE}], words=2).print("the title")
"""


# Names take 9 + 2 + 7 + 2 columns, each number 11 + 2: two fit into 46 columns, not into 45.
@pytest.mark.parametrize(
    ("columns", "blocks"),
    [("", [3]), ("59", [3]), ("46", [2, 1]), ("45", [1, 1, 1]), ("20", [1, 1, 1])],
)
def test_table(
    columns: str,
    blocks: list[int],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    TextTable("the caption", HEADINGS, [LINE], words=2).print("the title")
    lines = [line.split() for line in capsys.readouterr().out.splitlines() if line.strip()]
    assert (lines[0], lines[-1]) == (["the", "title"], ["the", "caption"])
    if columns != "20":
        rows = [line for line in lines if line[0] == "ppo"]
        assert rows == [["ppo", "N", *["-11,972,196"] * count] for count in blocks]


@pytest.mark.all
def test_terminal_keeps_its_width() -> None:
    printed = in_terminal([sys.executable, "-c", PRINT], columns=50)
    assert max(map(len, printed.splitlines())) <= 50 and printed.count("-11,972,196") == 3
