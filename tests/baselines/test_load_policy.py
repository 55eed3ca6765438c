"""``from baselines import load_policy``: how a policy comes into a user's program."""

from __future__ import annotations

import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest

from baselines import load_policy
from baselines.runs.files import RunError
from baselines.zoo.entries import FOLDER
from mbn_marl import BatchEngine
from mbn_marl.errors import MbnError

ROOT = Path(__file__).parents[2]


def test_a_policy_of_the_zoo_acts(tmp_path: Path) -> None:
    policy = load_policy("zoo:field_07")
    assert policy.observes == "observations"
    engine = BatchEngine("field_07", 2, observation="lidar")
    seen = engine.reset()
    actions = policy.act(seen, deterministic=True)
    assert actions.shape == (2, 3, 2) and np.isfinite(actions).all()
    shutil.copytree(FOLDER / "field_07", tmp_path / "run")
    for source in (tmp_path / "run", str(tmp_path / "run")):
        np.testing.assert_array_equal(load_policy(source).act(seen, deterministic=True), actions)


def test_an_unknown_source_is_named(tmp_path: Path) -> None:
    with pytest.raises(MbnError, match=r"zoo:nothing.*field_07"):
        load_policy("zoo:nothing")
    with pytest.raises(RunError, match=str(tmp_path)):
        load_policy(tmp_path)


def test_the_console_script_notices_another_package_called_baselines() -> None:
    """It begins with the module that checks (``tests/baselines/cli/test_main.py`` runs that)."""
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    assert scripts == {"mbn": "mbn_marl.__main__:main"}
