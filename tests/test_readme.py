"""The README's code runs, and its table of shapes is true."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from mbn_marl import parallel_env

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)


def test_there_are_blocks() -> None:
    assert len(BLOCKS) == 2


@pytest.mark.parametrize("block", BLOCKS, ids=range(len(BLOCKS)))
def test_code_runs(block: str) -> None:
    exec(compile(block, "README.md", "exec"), {})


def test_the_example_has_twelve_lines() -> None:
    assert len([line for line in BLOCKS[0].splitlines() if line]) <= 12


def test_shapes() -> None:
    env = parallel_env()
    env.reset()
    shapes = {
        "action": env.action_space("robot_0").shape,
        "observation": env.observation_space("robot_0").shape,
        "state": env.state().shape,
    }
    for name, shape in shapes.items():
        row = next(line for line in README.splitlines() if line.startswith(f"| {name} shape"))
        assert f"`{shape}`" in row, (name, shape)
    env.close()


def test_linked_files_exist() -> None:
    root = Path(__file__).parents[1]
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        if not target.startswith("http"):
            assert (root / target).is_file(), target
