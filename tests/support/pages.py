"""The code blocks of the README and of the site's pages, and a reader who does what they say."""

import json
import re
import shlex
import sys
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import chdir
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import yaml

from baselines.cli.main import main, read_command
from baselines.cli.options import read_options
from benchmarks.__main__ import benchmark_class
from mbn_marl import load_field
from mbn_marl.config import NavigationConfig
from mbn_marl.episode import play, save_episode

# The command, as a user calls it.
MBN = (sys.executable, "-c", "import sys; from baselines.cli import main; sys.exit(main())")
ROOT = Path(__file__).parents[2]
README = ROOT / "README.md"
EXTENDING = ROOT / "docs" / "extending.md"
PAGES = [README, ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]

NEEDS = ("", "checkout", "gpu", "cluster", "simulator")
"""Allowed in the comment before a block, ``<!-- needs: checkout -->``: the block is not for
everyone who has installed the package."""
BLOCK = re.compile(r"(?:^<!-- needs: (\w+) -->\n)?^```(.*?)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
FILE_NAME = re.compile(r"# (\S+\.(?:ya?ml|py))\n")

BUDGET = "--steps 1 --evaluate-every 4096 --episodes 2"
TINY: Mapping[str, str] = {
    "train": BUDGET,
    "transfer": f"{BUDGET} --fields field_03",
    "compare": f"{BUDGET} --fields field_03 --seeds 0 --processes 1",
    "tune": f"{BUDGET} --trials 1 --processes 1",
    "evaluate": "--episodes 2",
    "benchmark": "--tiers 1-convex",
    "plan": "--time-limit 5",
    "render": "--steps 5",
    "warmup": "--observation relative",
    "watch": "--episodes 1 --speed 1000",
}  # What the reader adds to a command, so that it takes a moment
TINY_GRID = {
    "algorithms": ["a2c"],
    "fields": ["field_03"],
    "settings": ["A"],
    "budget": {"steps": 1, "evaluate_every": 4096, "episodes": 2},
}  # What the reader changes in the file of a grid


@dataclass(frozen=True)
class Block:
    language: str
    text: str
    needs: str = ""


def blocks_of(page: Path) -> list[Block]:
    found = BLOCK.findall(page.read_text(encoding="utf-8"))
    return [
        Block(language, text, needs)
        for needs, language, text in found
        if not language.startswith("{")
    ]


def code_in_tables(page: Path) -> list[str]:
    rows = [line for line in page.read_text(encoding="utf-8").splitlines() if line[:1] == "|"]
    return re.findall(r"`([^`]+)`", "\n".join(rows))


def commands_of(block: Block) -> Iterator[list[str]]:
    for line in block.text.replace("\\\n", " ").splitlines():
        if words := shlex.split(line, comments=True):
            yield words


def write_file(block: Block, folder: Path) -> None:
    if name := FILE_NAME.match(block.text):
        path, text = folder / name[1], block.text
        path.parent.mkdir(parents=True, exist_ok=True)
        if block.language == "yaml" and "store" in (shown := yaml.safe_load(text)):
            text = yaml.safe_dump({**shown, **TINY_GRID})
        path.write_text(text, encoding="utf-8")


def write_own_files(folder: Path) -> None:
    """Write what the reader is taken to have: a map, a field, and an episode on it."""
    ring = [[0, 0], [400, 0], [400, 300], [0, 300], [0, 0]]
    (folder / "farm.geojson").write_text(json.dumps({"type": "Polygon", "coordinates": [ring]}))
    catalogue = (ROOT / "envs_catalog" / "field_03.yaml").read_text(encoding="utf-8")
    field = folder / "my_field.yaml"
    field.write_text(catalogue.replace("field_03", "my_field"), encoding="utf-8")
    episode = play(load_field(field), NavigationConfig(), np.zeros((2, 3, 2)))
    save_episode(episode, folder / "other.json")


def tiny(words: Sequence[str]) -> list[str]:
    return [*words, *TINY.get(words[0], "").split()]


def check_command(words: Sequence[str]) -> None:
    """Check that what a line names is there: a command of mbn, or what make, pip or python take."""
    match words:
        case ["mbn", *rest]:
            if "--help" not in rest:
                read_command(rest)
        case ["make", target]:
            makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
            assert re.search(rf"^{target}:", makefile, re.MULTILINE), words
        case ["pip", "install", *rest]:
            project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
            extras = project["project"]["optional-dependencies"]
            named = re.search(r"\[(.*)\]", rest[-1])
            assert rest[-1].startswith(".") and (named is None or named[1] in extras), words
        case ["python", "-m", "benchmarks", subject, *options]:
            read_options(benchmark_class(subject), options, f"benchmarks {subject}")
        case ["python", "-m", module, *_]:
            assert find_spec(module), words
        case ["python", file, *_]:
            assert (ROOT / file).is_file(), words
        case _:
            raise AssertionError(f"no reader can check {shlex.join(words)}")


def run_page(page: Path, folder: Path) -> None:
    """Run a page's Python, which shares its names, in ``folder``, or in the checkout it needs.

    Of its commands only ``mbn export`` is run, since the Python after it reads the file.
    """
    names = {"__name__": "__main__"}
    for block in blocks_of(page):
        if block.language in ("python", "yaml"):
            write_file(block, folder)
        if block.language == "python":
            with chdir(ROOT if block.needs == "checkout" else folder):
                exec(compile(block.text, str(page), "exec"), names)
        for words in commands_of(block) if block.language == "sh" else ():
            if words[:2] == ["mbn", "export"]:
                assert main(words[1:]) == 0
