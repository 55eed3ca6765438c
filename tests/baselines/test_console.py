"""What is printed keeps numbers and labels whole."""

import os
import pty
import subprocess
import sys

import pytest
from rich.table import Table

from baselines.console import console

LABELS = [f"a-rather-long-label-{k}" for k in range(8)]
PRINT = """
from rich.table import Table
from baselines.console import console
table = Table("a-rather-long-label-0", "text " * 40)
console().print(table)
"""


def test_a_pipe_gets_a_table_in_its_natural_width(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("FORCE_COLOR", "1")
    table = Table(*LABELS)
    table.add_row(*["-1,972,196"] * len(LABELS))
    console().print(table)
    printed = capsys.readouterr().out
    assert all(label in printed for label in LABELS)
    assert printed.count("-1,972,196") == len(LABELS)


def test_a_terminal_keeps_its_width() -> None:
    leader, follower = pty.openpty()
    environment = {**os.environ, "COLUMNS": "50", "TERM": "xterm"}
    process = subprocess.Popen([sys.executable, "-c", PRINT], stdout=follower, env=environment)
    os.close(follower)
    written = b""
    try:
        while block := os.read(leader, 4096):
            written += block
    except OSError:  # the other end is closed
        pass
    os.close(leader)
    assert process.wait() == 0
    border = written.decode().splitlines()[0]
    assert border[0] == "┏" and len(border) == 50
