"""``python -m tests.newcomer [PAGE ...]``: do what the pages say, with the wheel, elsewhere.

It installs the wheel into a new virtual environment and runs each page's command lines there, with
tiny budgets, from an empty folder; see CONTRIBUTING.md.
"""

import os
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import venv
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from numba import config
from numba.core.caching import _CacheLocator

from tests.support import pages
from tests.support.pages import PAGES, README, ROOT, blocks_of, commands_of, tiny
from tests.support.wheel import build_wheel

LONGEST = 600.0  # seconds that a command may take
PAGES_AT_A_TIME = 2
# They are answered with a message and exit code 2.
WRONG = ("mbn nonsense", "mbn evaluate nobody", "mbn train ppo field_99", "mbn plan missing.yaml")


class Newcomer:
    """Someone who has the wheel in a virtual environment; it may borrow this one's packages."""

    def __init__(self, folder: Path, *, borrows: bool) -> None:
        self._folder, self._cache = folder, folder / "cache"
        programs = folder / "venv" / "bin"
        self._environment = {
            **{name: os.environ[name] for name in ("HOME", "LANG") if name in os.environ},
            "PATH": f"{programs}:{os.environ['PATH']}",
            "NUMBA_CACHE_DIR": str(self._cache),
            "XDG_CONFIG_HOME": str(folder / "config"),
            "SDL_VIDEODRIVER": "dummy",  # a window that nobody sees
            "OMP_NUM_THREADS": "1",
            "PYTHONIOENCODING": "utf-8",
        }
        wheel = build_wheel(folder / "build")
        venv.create(folder / "venv")
        pip = [sys.executable, "-m", "pip", "--python", programs / "python", "install", "-q"]
        (self._site,) = (folder / "venv" / "lib").glob("*/site-packages")
        if borrows:
            subprocess.run([*pip, "--no-deps", wheel], check=True)
            # The .pth of the editable installation there has no effect: the checkout stays hidden.
            (self._site / "borrowed.pth").write_text(sysconfig.get_path("purelib"))
        else:
            pip += ["-c", ROOT / "constraints.txt"]
            subprocess.run([*pip, "torch"], check=True)
            subprocess.run([*pip, f"{wheel}[export]"], check=True)

    def take_compiled(self) -> None:
        """Take over what the tests have compiled, which Numba keeps by the path of the source."""
        place = _CacheLocator.get_suitable_cache_subpath
        for folder in {source.parent for source in (ROOT / "mbn_marl").rglob("*.py")}:
            known = Path(config.CACHE_DIR, place(str(folder / "any.py")))
            if config.CACHE_DIR and known.is_dir():
                own = self._cache / place(str(self._site / folder.relative_to(ROOT) / "any.py"))
                shutil.copytree(known, own, dirs_exist_ok=True)

    def run(self, words: Sequence[str], folder: Path, code: int = 0) -> str:
        """Run a command in a pipe; return its output."""
        how = {"cwd": folder, "env": self._environment, "timeout": LONGEST}
        done = subprocess.run(words, capture_output=True, text=True, **how)
        assert done.returncode == code, f"exit code {done.returncode}: {done.stderr[-2000:]}"
        assert "Traceback" not in done.stdout + done.stderr, done.stderr[-2000:]
        assert code == 0 or done.stderr.strip(), "no message"
        return done.stdout

    def read(self, page: Path) -> list[str]:
        """Do what a page says in a folder for it alone; return what is wrong."""
        wrong = []
        folder = self._folder / str(page.relative_to(ROOT)).replace("/", "-")
        folder.mkdir()
        pages.write_own_files(folder)
        for line in lines_of(page, folder):
            words = ["mbn", *tiny(line[1:])] if line[0] == "mbn" else line
            name = f"{page.relative_to(ROOT)}: {shlex.join(line)}"
            try:
                self.run(words, folder)
                print(f"ok  {name}", flush=True)
            except (AssertionError, subprocess.TimeoutExpired) as error:
                print(f"NO  {name}\n{error}", flush=True)
                wrong.append(name)
        return wrong


def lines_of(page: Path, folder: Path) -> Iterator[list[str]]:
    for block in blocks_of(page):
        if block.language in ("yaml", "python"):
            pages.write_file(block, folder)
        elif block.language == "sh" and not block.needs:
            yield from commands_of(block)
    if page == README:
        code = [block.text for block in blocks_of(page) if block.language == "python"]
        yield ["python", "-c", "\n".join(code)]


def main(*names: str) -> int:
    """Read the named pages, or all; return 1 if a command does not do what they say."""
    everything = [page for page in PAGES if "results" not in page.parts]
    chosen = [ROOT / name for name in names] or everything
    with tempfile.TemporaryDirectory(prefix="newcomer") as name:
        folder = Path(name)
        newcomer = Newcomer(folder, borrows=bool(names))
        newcomer.take_compiled()
        (folder / "empty").mkdir()
        for line in WRONG:
            newcomer.run(shlex.split(line), folder / "empty", code=2)
        with ThreadPoolExecutor(PAGES_AT_A_TIME) as readers:
            wrong = [line for found in readers.map(newcomer.read, chosen) for line in found]
    print(*wrong, f"{len(wrong)} command lines do not do what the pages say", sep="\n")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
