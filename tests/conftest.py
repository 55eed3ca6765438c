"""Settings of the whole test run."""

from __future__ import annotations

from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path

import pytest
from hypothesis import settings

FOLDER = Path(__file__).parent
SLOW = (
    "adapters/test_forms.py",
    "adapters/test_supersuit.py",
    "adapters/test_torchrl.py",
    "baselines/*",
    "benchmarks/*",
    "engine/test_blocks.py",
    "engine/test_cuda*.py",
    "engine/test_jit.py",
    "planning/test_bounds.py",
    "sim3d/*",
    "test_docs.py",
    "web/*",
)
"""Tests that take seconds of computing: they compile, train, start processes, run pages."""
QUICK = ("baselines/cli/test_options.py", "baselines/test_console.py")
"""Those among them that do not."""

# Derandomised, so that a red run is red for everybody; no deadline, since a first example compiles.
settings.register_profile("repeatable", derandomize=True, deadline=None, database=None)
settings.load_profile("repeatable")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what is slow, beside the tests that are marked themselves."""
    for item in items:
        place = str(item.path.relative_to(FOLDER))
        if any(fnmatch(place, slow) for slow in SLOW) and place not in QUICK:
            item.add_marker("slow")


@pytest.fixture(scope="session", autouse=True)
def own_home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A place for the user's key that is no user's."""
    with pytest.MonkeyPatch.context() as patch:
        home = tmp_path_factory.mktemp("config")
        patch.setenv("XDG_CONFIG_HOME", str(home))
        yield home
