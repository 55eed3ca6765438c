"""Imports point one way, and what is heavy is loaded only by those who use it."""

import ast
import functools
import re
import subprocess
import sys
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LAYERS = [
    {"mbn_marl.errors", "mbn_marl.version"},
    {"mbn_marl.jit", "mbn_marl.config", "mbn_marl.files"},
    {"mbn_marl.field"},
    {"mbn_marl.optimum"},
    {"mbn_marl.engine"},
    {"mbn_marl.planning"},
    {"mbn_marl.episode"},
    {"mbn_marl.render"},
    {"mbn_marl.sim3d"},
    {"mbn_marl.adapters", "mbn_marl.registration"},
    {"mbn_marl.navigation_v0"},
    {"mbn_marl"},
    {"docs.extensions"},
    {"baselines"},
    {"baselines.cli"},
    {"benchmarks"},
]
"""From the left to the right; an import points to the left or stays within its package."""
RANK = {package: rank for rank, packages in enumerate(LAYERS) for package in packages}
MODULES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for folder in ("mbn_marl", "baselines", "benchmarks", "docs/extensions")
    for path in sorted((ROOT / folder).rglob("*.py"))
}
HEAVY = {"numba", "torch", "pygame", "matplotlib", "PIL", "stable_baselines3", "torchrl", "imageio"}


def package_of(module: str) -> str:
    top, *rest = module.split(".")
    own = top in ("mbn_marl", "docs") or rest[:1] == ["cli"]
    return f"{top}.{rest[0]}" if own and rest else top


@functools.cache
def nodes_of(module: str) -> list[ast.AST]:
    return [*ast.walk(ast.parse(MODULES[module].read_text(encoding="utf-8")))]


def imports_of(module: str) -> Iterator[str]:
    for node in nodes_of(module):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module} imports relatively"
            modules = [f"{node.module}.{alias.name}" for alias in node.names]
            names = [name if name in MODULES else str(node.module) for name in modules]
        else:
            continue
        yield from (name for name in names if name in MODULES)


def named_in(module: str) -> Iterator[str]:
    # Such names are loaded later.
    for node in nodes_of(module):
        if isinstance(node, ast.Constant) and node.value in MODULES and "." in str(node.value):
            yield node.value


def test_every_module_has_a_layer_and_imports_point_to_the_left():
    assert {package_of(module) for module in MODULES} == set(RANK)
    for module in MODULES:
        own = package_of(module)
        for imported in (*imports_of(module), *named_in(module)):
            other = package_of(imported)
            assert other == own or RANK[other] < RANK[own], f"{module} imports {imported}"


def test_no_circle_within_a_package():
    plain = {name for name, path in MODULES.items() if path.name != "__init__.py"}
    graph = {module: {*imports_of(module)} & plain - {module} for module in MODULES}
    TopologicalSorter(graph).prepare()  # raises CycleError, which names the circle


def test_a_folder_of_baselines_imports_from_those_above_it_in_the_readme():
    table = (ROOT / "baselines" / "README.md").read_text(encoding="utf-8")
    order = ["algorithms", "console", *re.findall(r"^\| `(\w+)/`", table, re.MULTILINE)]
    modules = [name for name in MODULES if name.startswith("baselines.")]
    assert sorted({name.split(".")[1] for name in modules}) == sorted(order)
    for module in modules:
        place = order.index(module.split(".")[1])
        for other in (name for name in imports_of(module) if name.startswith("baselines.")):
            assert order.index(other.split(".")[1]) <= place, f"{module} imports {other}"


def loaded_by(statement: str) -> set[str]:
    code = f"import sys; {statement}; print(*{{name.split('.')[0] for name in sys.modules}})"
    run = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return set(run.stdout.split())


@pytest.mark.slow
def test_what_is_loaded():
    run = "from baselines.cli import main"
    for statement, allowed in (
        ("import mbn_marl, mbn_marl.render; from baselines import load_policy", set()),
        (f"{run}; main(['--help'])", set()),
        (f"{run}; main(['fields'])", set()),
        ("import gymnasium, mbn_marl; gymnasium.spec('mbn/field_03-v0')", set()),
        ("from mbn_marl import centralized_env; centralized_env('field_03')", {"numba"}),
    ):
        loaded = loaded_by(statement)
        assert "mbn_marl" in loaded, statement
        assert loaded & HEAVY <= allowed, statement
