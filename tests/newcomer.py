"""``python -m tests.newcomer``: do what the pages say, with the wheel, in an empty environment.

It builds the wheel, installs it with the extra ``export`` into a new virtual environment, and runs
every command line of the README and of docs from an empty folder, without a checkout: with tiny
budgets, page by page, in order. Blocks under a comment ``<!-- needs: ... -->`` and the pages
of results, which record what was run, are left out. Each command runs in a pipe; one that prints a
table runs again in a terminal of 80 columns, where no number or label may be broken. The first
command of all compiles the engine; the others may use what the tests have compiled.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import venv
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from numba import config
from numba.core.caching import _CacheLocator

from tests.support.pages import (
    PAGES,
    ROOT,
    blocks_of,
    commands_of,
    tiny,
    write_file,
    write_own_files,
)
from tests.support.terminal import in_terminal
from tests.support.wheel import build_wheel

WIDTH = 80
LONGEST = 600.0
"""Seconds that a command may take."""
PAGES_AT_A_TIME = 2
RULE = re.compile("[─━═╌]{3}")
WRONG = ("mbn nonsense", "mbn evaluate nobody", "mbn train ppo field_99", "mbn plan missing.yaml")
"""Command lines that are answered with a message and exit code 2."""


class Token(NamedTuple):
    """A word on a line, with the columns where it starts and ends."""

    text: str
    start: int
    end: int


def tokens(line: str) -> list[Token]:
    """Return the words of a line."""
    return [Token(found[0], found.start(), found.end()) for found in re.finditer(r"\S+", line)]


def broken_words(whole: str, narrow: str) -> Iterator[str]:
    """Yield the words of ``whole`` that ``narrow`` has in two parts, one below the other.

    The parts start or end in the same column, as those of a cell do. Times differ between two runs:
    a word that is just not there is none.
    """
    lines = [tokens(line) for line in narrow.splitlines()]
    words = {token.text for line in whole.splitlines() for token in tokens(line)}
    present = {token.text for line in lines for token in line}
    for above, below in pairwise(lines):
        for first in above:
            for second in below:
                aligned = first.start == second.start or first.end == second.end
                word = first.text + second.text
                if aligned and word in words - present:
                    yield word
    if "…" in narrow:
        yield next(line for line in narrow.splitlines() if "…" in line).strip()


class Newcomer:
    """Someone who has installed the wheel into an environment of their own.

    Args:
        folder: to work in.
    """

    def __init__(self, folder: Path) -> None:
        self._bin = folder / "venv" / "bin"
        self._folder, self._cache = folder, folder / "cache"
        kept = {name: os.environ[name] for name in ("PATH", "HOME", "LANG") if name in os.environ}
        self._environment = {
            **kept,
            "PATH": f"{self._bin}:{kept['PATH']}",
            "NUMBA_CACHE_DIR": str(self._cache),
            "XDG_CONFIG_HOME": str(folder / "config"),
            "SDL_VIDEODRIVER": "dummy",  # a window that nobody sees
            "OMP_NUM_THREADS": "1",
            "PYTHONIOENCODING": "utf-8",
        }

    def install(self) -> None:
        """Install the wheel, with torch and all else as the constraints have it."""
        wheel = build_wheel(self._folder / "build")
        venv.create(self._folder / "venv", with_pip=True)
        pip = [str(self._bin / "pip"), "install", "-q", "-c", str(ROOT / "constraints.txt")]
        subprocess.run([*pip, "torch"], check=True)
        subprocess.run([*pip, f"{wheel}[export]"], check=True)

    def take_compiled(self) -> int:
        """Take over what the tests have compiled; return how many files that is.

        Numba keeps it by the path of the source, and the package uses it for the same sources only.
        """
        place, files = _CacheLocator.get_suitable_cache_subpath, 0
        (site,) = (self._folder / "venv" / "lib").glob("*/site-packages")
        for folder in {source.parent for source in (ROOT / "mbn_marl").rglob("*.py")}:
            known = Path(config.CACHE_DIR, place(str(folder / "any.py")))
            if config.CACHE_DIR and known.is_dir():
                own = self._cache / place(str(site / folder.relative_to(ROOT) / "any.py"))
                shutil.copytree(known, own, dirs_exist_ok=True)
                files += len([*known.iterdir()])
        return files

    def run(self, words: Sequence[str], folder: Path, code: int = 0) -> str:
        """Run a command in a pipe; return its output."""
        done = subprocess.run(
            words,
            cwd=folder,
            env=self._environment,
            capture_output=True,
            text=True,
            timeout=LONGEST,
        )
        assert done.returncode == code, f"exit code {done.returncode}: {done.stderr[-2000:]}"
        assert "Traceback" not in done.stdout + done.stderr, done.stderr[-2000:]
        assert code == 0 or done.stderr.strip(), "no message"
        return done.stdout

    def try_command(self, words: Sequence[str], folder: Path) -> None:
        """Run a command in a pipe, and in a terminal too if it prints a table."""
        with tempfile.TemporaryDirectory(dir=self._folder) as other:
            before = shutil.copytree(folder, Path(other) / "before", symlinks=True)
            whole = self.run(words, folder)
            if RULE.search(whole):
                narrow = in_terminal(words, WIDTH, folder=before, environment=self._environment)
                broken = [*broken_words(whole, narrow)]
                assert not broken, f"broken at {WIDTH} columns: {broken}\n{narrow}"

    def read(self, page: Path) -> list[str]:
        """Do what a page says in a folder of its own; return what is wrong."""
        wrong = []
        folder = self._folder / str(page.relative_to(ROOT)).replace("/", "-")
        folder.mkdir()
        write_own_files(folder)
        for block in blocks_of(page):
            if block.language in ("yaml", "python"):
                write_file(block, folder)
            for line in commands_of(block) if block.language == "sh" and not block.needs else ():
                words = ["mbn", *tiny(line[1:])] if line[0] == "mbn" else line
                name = f"{page.relative_to(ROOT)}: {shlex.join(line)}"
                try:
                    self.try_command(words, folder)
                    print(f"ok  {name}", flush=True)
                except (AssertionError, subprocess.TimeoutExpired) as error:
                    print(f"NO  {name}\n{error}", flush=True)
                    wrong.append(name)
        return wrong


def main() -> int:
    """Be a newcomer.

    Returns:
        The exit code: 1 if a command did not do what the pages say.
    """
    pages = [
        page
        for page in PAGES
        if "results" not in page.parts and any(block.language == "sh" for block in blocks_of(page))
    ]
    with tempfile.TemporaryDirectory(prefix="newcomer") as name:
        folder = Path(name)
        newcomer = Newcomer(folder)
        newcomer.install()
        (folder / "empty").mkdir()
        newcomer.run(["mbn", "evaluate", "zoo:field_07", "--episodes", "2"], folder / "empty")
        print(newcomer.take_compiled(), "files of compiled code are the tests'", flush=True)
        for line in WRONG:
            newcomer.run(shlex.split(line), folder / "empty", code=2)
        with ThreadPoolExecutor(PAGES_AT_A_TIME) as readers:
            wrong = [line for found in readers.map(newcomer.read, pages) for line in found]
    print(*wrong, f"{len(wrong)} command lines do not do what the pages say", sep="\n")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
