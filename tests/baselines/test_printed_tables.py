"""What commands print, on a terminal of 80 columns and in a pipe: no number or label is broken."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.records import make_run
from tests.support.terminal import in_terminal

MBN = "import sys; from baselines.cli.main import main; sys.exit(main(sys.argv[1:]))"
COMPARISON = """
import sys
from pathlib import Path
from baselines.compare.records import find_records
from baselines.compare.results import Results
from baselines.compare.summary import summarise
from baselines.compare.tables import print_comparison
from baselines.console import console
print_comparison(summarise(Results.of(find_records([Path(sys.argv[1])]))), console())
"""
LABEL = "ppo-shared-with-a-long-label"


def printed(code: str, arguments: list[str], *, piped: bool) -> str:
    """What Python code writes."""
    command = [sys.executable, "-c", code, *arguments]
    if not piped:
        return in_terminal(command)
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def words_of(text: str) -> list[str]:
    """The words between two or more spaces, which no cell has inside."""
    return [word for line in text.splitlines() for word in re.split(r"\s{2,}", line.strip())]


@pytest.mark.parametrize("piped", [False, True])
def test_a_comparison_is_printed_whole(piped: bool, tmp_path: Path) -> None:
    low = {"return_mean": -1_972_196.0, "success_rate": 0.0, "makespan": 1000.0}
    history = [{"env_steps": 100, "seconds": 1.0, "return_mean": -5.0}]
    for label, sign in (("mappo", 1.0), (LABEL, 10.0)):
        for seed in (0, 1):
            sampled = {**low, "return_mean": sign * low["return_mean"] - seed * 10**6}
            final = {"env_steps": 400, "seconds": 1.0, "stochastic": sampled, "deterministic": low}
            make_run(tmp_path, label=label, seed=seed, recorded=(history, final))
    text = printed(COMPARISON, [str(tmp_path)], piped=piped)
    lines = text.splitlines()
    # Means over the two seeds, and the bounds that one seed alone gives.
    for cell in (LABEL, "-2,472,196", "-20,221,960", "-20722.0..-19722.0", "-1,972,196", "- 0/2"):
        assert cell in words_of(text), cell
    assert sum(LABEL in line for line in lines) == (4 if piped else 6), "once a block"
    if not piped:
        assert max(map(len, lines)) <= 80


@pytest.mark.parametrize("piped", [False, True])
def test_commands_print_their_tables_whole(piped: bool) -> None:
    zoo = words_of(printed(MBN, ["zoo"], piped=piped))
    assert {"zoo:field_03", "zoo:field_10", "159,490", "env-steps"} <= set(zoo)
    text = printed(MBN, ["evaluate", "zoo:field_03", "--episodes", "2"], piped=piped)
    for cell in ("sampled", "deterministic:", "159,490", "100.0%", "17.0", "0.00%"):
        assert cell in words_of(text), cell
