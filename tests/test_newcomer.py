"""The newcomer's checks for what is broken at 80 columns, and the compiled code that it is lent."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import pytest
from numba import config

from tests.engine.test_jit import probe
from tests.newcomer import WIDTH, Newcomer, broken_words
from tests.support.pages import ROOT
from tests.support.terminal import in_terminal

WHOLE = """
 algo        return  seconds
 ppo-shared  -1,972,196  3.1
 mappo       159,165  12.5
"""


@pytest.mark.parametrize(
    ("narrow", "broken"),
    [
        (WHOLE, []),
        (" ppo-shared  -1,972,196  9.4\n mappo  159,165  88.0", []),
        (" ppo-shar  -1,972,196\n ed\n mappo  159,165", ["ppo-shared"]),
        (" ppo-shared  -1,972,1\n                   96", ["-1,972,196"]),
        (" ppo-shared  -1,972,1\n 96", []),  # not in the same cell
        (" ppo-sha…  -1,972,196", ["ppo-sha…  -1,972,196"]),
    ],
    ids=["whole", "other times", "label", "number", "another cell", "cut off"],
)
def test_broken_words(narrow: str, broken: list[str]) -> None:
    assert [*broken_words(WHOLE, narrow)] == broken


def test_a_terminal_has_80_columns() -> None:
    code = "import os; print('lost\\r', os.get_terminal_size().columns, '\\x1b[1mbold\\x1b[0m')"
    assert in_terminal([sys.executable, "-c", code]) == f" {WIDTH} bold\n"


@pytest.mark.slow
def test_the_newcomer_is_lent_compiled_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    newcomer, site = Newcomer(tmp_path), tmp_path / "venv" / "lib" / "python" / "site-packages"
    for name in ("mbn_marl", "envs_catalog"):
        shutil.copytree(ROOT / name, site / name)
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path / "tests"))
    assert probe(ROOT, tmp_path / "tests") == ["3.5", "0"]
    assert newcomer.take_compiled() == 2  # an index and the code
    assert probe(site, tmp_path / "cache") == ["3.5", "1"]
