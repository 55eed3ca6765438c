"""The scripts of ``examples`` that run on the versions of ``constraints.txt`` do so, tiny."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[1] / "examples"
TINY = {
    "cleanrl_ppo": ("--steps 1200 --worlds 8", r"\d+ episodes ended .*return (-?[\d,]+|nan)"),
    "sb3_ppo": ("--steps 1 --worlds 8", r"1536 robot-steps, success \d+%"),
    "skrl_ppo": ("--steps 1200 --worlds 8", r"\d+ episodes ended, return .*: (-?[\d,]+|nan)"),
}
"""For each script, options that make it short, and the output to expect."""
ELSEWHERE = {"agilerl_ippo", "benchmarl_task", "minari_dataset", "rllib_ppo", "tianshou_ppo"}
"""Their libraries want other versions than ours, or JAX: run by hand, with those."""


@pytest.mark.all
@pytest.mark.parametrize("name", TINY)
def test_an_example_runs(name):
    words, printed = TINY[name]
    command = [sys.executable, FOLDER / f"{name}.py", *words.split()]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert re.fullmatch(printed, done.stdout.strip())


def test_every_example_is_known():
    assert {path.stem for path in FOLDER.glob("*.py")} == TINY.keys() | ELSEWHERE
