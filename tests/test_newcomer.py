"""The newcomer's check for what is broken at 80 columns, and the terminal that it uses."""

from __future__ import annotations

import sys

from tests.newcomer import WIDTH, broken_words
from tests.support.terminal import in_terminal

WHOLE = """
 algo        return  seconds
 ppo-shared  -1,972,196  3.1
 mappo       159,165  12.5
"""


def test_broken_words() -> None:
    for narrow, broken in (
        (WHOLE, []),
        (" ppo-shared  -1,972,196  9.4\n mappo  159,165  88.0", []),  # other times
        (" ppo-shar  -1,972,196\n ed\n mappo  159,165", ["ppo-shared"]),
        (" ppo-shared  -1,972,1\n                   96", ["-1,972,196"]),
        (" ppo-shared  -1,972,1\n 96", []),  # not in the same cell
        (" ppo-sha…  -1,972,196", ["ppo-sha…  -1,972,196"]),
    ):
        assert [*broken_words(WHOLE, narrow)] == broken, narrow


def test_a_terminal_has_80_columns() -> None:
    code = "import os; print('lost\\r', os.get_terminal_size().columns, '\\x1b[1mbold\\x1b[0m')"
    assert in_terminal([sys.executable, "-c", code]) == f" {WIDTH} bold\n"
