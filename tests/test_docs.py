"""Pages, notebooks, docstrings: their code runs, their names exist, they say what they should."""

import importlib
import importlib.util
import os
import re
import shutil
import subprocess
import sys

import nbformat
import pytest
import yaml

import mbn_marl
from baselines.algorithms import find_algorithm
from baselines.cli.main import COMMANDS, main
from docs.extensions import notebooks
from mbn_marl import parallel_env
from tests.support import pages
from tests.support.pages import EXTENDING, MBN, NEEDS, PAGES, README, ROOT, TINY, blocks_of

TEXT = README.read_text(encoding="utf-8")
RUN = [
    page
    for page in PAGES
    if page != EXTENDING and any(block.language == "python" for block in blocks_of(page))
]
CODE = re.compile(r"`(?!mbn_marl)(\w+)\.(\w+)`")


@pytest.mark.slow
def test_commands_exist_and_marks_are_known(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pages.write_own_files(tmp_path)
    for page in PAGES:
        blocks = blocks_of(page)
        for block in blocks:
            assert block.language in ("", "diff", "python", "sh", "yaml"), page
            if block.language in ("python", "yaml"):
                pages.write_file(block, tmp_path)
            if block.language == "sh" and page != EXTENDING:  # the recipes' own are not there yet
                for words in pages.commands_of(block):
                    pages.check_command(words)
        for code in pages.code_in_tables(page):
            words = code.split() if re.match(r"mbn |python -m ", code) else []
            if len(words) == 2:
                assert words[1] in COMMANDS, (page, code)
            elif words and not re.search(r"\b[A-Z]+\b|\.\.", code):  # placeholders
                pages.check_command(words)
                if words[1:3] == ["fields", "--generate"]:
                    assert main(words[1:]) == 0
        marks = re.findall(r"(?m)^<!-- needs:(.*)-->$", page.read_text(encoding="utf-8"))
        assert {mark.strip() for mark in marks} <= {*NEEDS}, page
        assert len(marks) == sum(bool(block.needs) for block in blocks), page


CALLS = re.compile(
    r"(from|import) |(parallel_|centralized_)?env\(|BatchEngine\(|gymnasium\.|pettingzoo\."
)


@pytest.mark.parametrize("page", ["README", "docs/tasks", "docs/clients"])
def test_python_in_tables_runs(page):
    for code in filter(CALLS.match, pages.code_in_tables(ROOT / f"{page}.md")):
        exec(f"import gymnasium, pettingzoo\nfrom mbn_marl import *\n{code}", {})


@pytest.mark.all
@pytest.mark.parametrize("page", RUN, ids=lambda page: str(page.relative_to(ROOT)))
def test_python_runs(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pages.write_own_files(tmp_path)
    pages.run_page(page, tmp_path)


@pytest.mark.all
def test_recipes_fit_the_code(tmp_path):
    for package in ("mbn_marl", "baselines", "envs_catalog"):
        shutil.copytree(ROOT / package, tmp_path / package)
    own = {"PYTHONPATH": str(tmp_path), "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    how = {"cwd": tmp_path, "env": os.environ | own}

    def run(*command: str, text: str | None = None) -> None:
        done = subprocess.run(command, input=text, capture_output=True, text=True, **how)
        assert done.returncode == 0, done.stderr

    languages = set()
    for block in blocks_of(EXTENDING):
        languages.add(block.language)
        match block.language:
            case "diff":
                run("git", "apply", "-C1", "-", text=block.text)
            case "yaml":
                pages.write_file(block, tmp_path)
            case "python":
                run(sys.executable, "-c", block.text)
            case "sh":
                for words in pages.commands_of(block):
                    run(*MBN, *words[1:], *TINY[words[1]].split())
    assert languages == {"diff", "yaml", "python", "sh"}


@pytest.mark.all
@pytest.mark.parametrize("path", notebooks.notebooks(), ids=lambda path: path.stem)
def test_notebook_prints_what_it_keeps(path):
    kept = nbformat.read(path, as_version=4)
    assert notebooks.texts(notebooks.run(path)) == notebooks.texts(kept)
    assert any(text for cell in notebooks.texts(kept) for text in cell)


def test_shapes():
    env = parallel_env()
    env.reset()
    spaces = env.action_space("robot_0"), env.observation_space("robot_0"), env.state_space
    for name, space in zip(("action", "observation", "state"), spaces, strict=True):
        row = next(line for line in TEXT.splitlines() if line.startswith(f"| {name}"))
        assert f"`{space.shape}`" in row, name


def test_linked_files_exist():
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#]+)", page.read_text(encoding="utf-8")):
            assert target.startswith("http") or (page.parent / target).is_file(), (page, target)


def test_the_table_of_algorithms_says_what_each_robot_observes():
    page = (ROOT / "docs" / "baselines.md").read_text(encoding="utf-8")
    rows = re.findall(r"(?m)^\| `([\w-]+)` \|.*\| own `(\w+)`", page)
    assert [name for name, _ in rows] == ["mappo", "ppo-shared"]
    for name, observed in rows:
        assert find_algorithm(name).resolve({}).environment["observation"] == observed


def test_the_code_of_the_equations_exists():
    page = (ROOT / "docs" / "mdp.md").read_text(encoding="utf-8")
    section = page.split("## The equations")[1].split("\n## ")[0]
    named = CODE.findall(section)
    assert len(named) > 15
    for module, name in named:
        of_the_paper = importlib.util.find_spec(f"mbn_marl.engine.mdp.{module}") is not None
        package = "mbn_marl.engine.mdp" if of_the_paper else "mbn_marl.jit"
        assert hasattr(importlib.import_module(f"{package}.{module}"), name), (module, name)


def test_api_pages_have_every_public_name():
    texts = [path.read_text(encoding="utf-8") for path in (ROOT / "docs" / "api").glob("*.md")]
    documented = set(re.findall(r"auto\w+:: (\S+)", "\n".join(texts)))
    last = {name.rpartition(".")[2] for name in documented}
    for package in ("mbn_marl", "mbn_marl.planning", "mbn_marl.sim3d"):
        module = importlib.import_module(package)
        for name in module.__all__:
            value = getattr(module, name)
            assert {name, getattr(value, "__name__", name)} & last, (package, name)


def test_citation_and_issue_forms_are_complete():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert {"cff-version", "message", "title", "authors"} <= set(citation)
    assert str(citation["version"]) == mbn_marl.__version__
    for path in (ROOT / ".github").rglob("*.yml"):
        form = yaml.safe_load(path.read_text(encoding="utf-8"))
        assert path.stem == "config" or {"name", "description", "body"} <= set(form), path
