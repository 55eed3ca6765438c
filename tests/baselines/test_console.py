"""What is printed keeps numbers and labels whole."""

import io
import sys

import pytest
from rich.table import Table

from baselines.console import WholeCells, console
from tests.support.terminal import in_terminal

LABELS = [f"a-rather-long-label-{k}" for k in range(8)]
PRINT = """
from rich.table import Table
from baselines.console import console
table = Table("a-rather-long-label-0", "text " * 40)
console().print(table)
"""

NAMES = ("crossq-A-field_01-seed33", "short-sighted-field_03-seed0")
BARS = f"""
from baselines.training.progress_bar import Report, progress_bars
with progress_bars({NAMES}, 1000) as show:
    show(Report("{NAMES[1]}", 600, True, 842.0, -9_543_760.0, 0.05))
"""


def wide_table() -> Table:
    """Two columns of names, and four of numbers that take 12 columns each."""
    looks = {"box": None, "padding": (0, 1, 0, 0), "pad_edge": False}
    table = Table(title="the title", caption="the caption", **looks)
    for heading in ("algorithm", "setting"):
        table.add_column(heading, justify="left")
    for k in range(4):
        table.add_column(f"number-{k}", justify="right")
    table.add_row("ppo", "N", *["-11,972,196"] * 4)
    return table


def printed(width: int) -> list[list[str]]:
    """The words of each line that is not empty."""
    out = io.StringIO()
    WholeCells(width=width, file=out).print(wide_table())
    return [line.split() for line in out.getvalue().splitlines() if line.strip()]


def test_a_pipe_gets_a_table_in_its_natural_width_or_that_of_columns(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    table = Table(*LABELS)
    table.add_row(*["-1,972,196"] * len(LABELS))
    for columns, fits in (("", False), ("1", False), ("80", True)):
        monkeypatch.setenv("COLUMNS", columns)
        console().print(table)
        printed = capsys.readouterr().out
        assert all(label in printed for label in LABELS)
        assert printed.count("-1,972,196") >= len(LABELS)
        assert (len(printed.splitlines()[0]) <= 80) == fits


@pytest.mark.all
def test_a_terminal_keeps_its_width() -> None:
    border = in_terminal([sys.executable, "-c", PRINT], columns=50).splitlines()[0]
    assert border[0] == "┏" and len(border) == 50


def test_a_table_that_is_too_wide_is_printed_in_blocks() -> None:
    # Names take 9 + 1 + 7 columns, each number 1 + 11: two fit into 42 columns, not into 40.
    number, names = "-11,972,196", ["algorithm", "setting"]
    assert printed(42) == [
        ["the", "title"],
        [*names, "number-0", "number-1"],
        ["ppo", "N", number, number],
        [*names, "number-2", "number-3"],
        ["ppo", "N", number, number],
        ["the", "caption"],
    ]
    assert [line for line in printed(40) if line[0] == "algorithm"] == [
        [*names, f"number-{k}"] for k in range(4)
    ]
    assert printed(66)[1:3] == [
        [*names, *(f"number-{k}" for k in range(4))],
        ["ppo", "N", *[number] * 4],
    ]


@pytest.mark.all
def test_a_narrow_terminal_leaves_parts_of_progress_out_and_cuts_none() -> None:
    whole = ["60%", "842/s", "return", "-9,543,760", "success", "5%", "0:00:00"]
    # The name takes 28 columns, then 10, 4, 6, 30 and 7, each after a space.
    for columns, shown in ((90, ["━" * 10, *whole]), (79, whole), (78, whole[:-1]), (63, ["60%"])):
        bars = in_terminal([sys.executable, "-c", BARS], columns)
        assert "…" not in bars
        waiting, running = bars.replace("╺", "━").splitlines()[-2:]
        assert waiting.split()[0] == NAMES[0]
        assert running.split() == [NAMES[1], *shown]
