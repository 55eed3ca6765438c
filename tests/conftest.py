"""Settings of the whole test run."""

from __future__ import annotations

import os
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path

import pytest
from hypothesis import settings

# Threads that spin while they wait take the cores from the tests that run beside them.
os.environ |= {"OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "passive"}

FOLDER = Path(__file__).parent
SLOW = (
    "adapters/test_forms.py",
    "adapters/test_torchrl.py",
    "baselines/classical/test_classical.py",
    "baselines/cli/test_commands.py",
    "baselines/cli/test_deploy.py",
    "baselines/cli/test_episodes.py",
    "baselines/cli/test_main.py",
    "baselines/compare/test_benchmark.py",
    "baselines/compare/test_compare_run.py",
    "baselines/demo/test_window.py",
    "baselines/evaluation/test_wind.py",
    "baselines/paper/test_paper.py",
    "baselines/runs/test_checksums.py",
    "baselines/sb3/test_centralized.py",
    "baselines/sb3/test_shared.py",
    "baselines/sweep/test_grid.py",
    "baselines/sweep/test_grid_ray.py",
    "baselines/sweep/test_grid_store.py",
    "baselines/test_printed_tables.py",
    "baselines/torchrl/test_trainer.py",
    "baselines/training/test_learning.py",
    "baselines/training/test_loggers.py",
    "baselines/training/test_reliability.py",
    "baselines/training/test_resume.py",
    "baselines/tuning/test_tune.py",
    "baselines/zoo/test_zoo.py",
    "benchmarks/*",
    "engine/test_blocks.py",
    "engine/test_cuda.py",
    "engine/test_determinism.py",
    "engine/test_jit.py",
    "planning/test_bounds.py",
    "sim3d/test_coppeliasim.py",
    "sim3d/test_mujoco.py",
    "test_docs.py",
    "test_examples.py",
    "test_package.py",
    "web/*",
)
"""Files whose tests take seconds: they compile, train, start processes, open pages."""
LONGEST = ("test_in_the_simulator", "test_recipes_fit_the_code")
"""They begin first, so that the two workers end at about the same time."""

# Derandomised, so that a red run is red for everybody; no deadline, since a first example compiles.
settings.register_profile("repeatable", derandomize=True, deadline=None, database=None)
settings.load_profile("repeatable")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what is slow, beside the tests that are marked themselves."""
    items.sort(key=lambda item: item.name.partition("[")[0] not in LONGEST)
    for item in items:
        place = str(item.path.relative_to(FOLDER))
        if any(fnmatch(place, slow) for slow in SLOW):
            item.add_marker("slow")


@pytest.fixture(scope="session", autouse=True)
def own_home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A place for the user's key that is no user's."""
    with pytest.MonkeyPatch.context() as patch:
        home = tmp_path_factory.mktemp("config")
        patch.setenv("XDG_CONFIG_HOME", str(home))
        yield home
