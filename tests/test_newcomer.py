"""The newcomer's check for what is broken at 80 columns, and the terminal that it uses."""

from __future__ import annotations

from tests.newcomer import broken_words

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
