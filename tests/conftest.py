"""Settings of the whole test run."""

import os

import pytest
from hypothesis import settings

# Threads that spin while they wait take the cores from the tests that run beside them.
os.environ |= {"OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "passive"}

pytest_plugins = ["tests.support.configurations"]

# Derandomised, so that a red run is red for everybody; no deadline, since a first example compiles.
settings.register_profile("repeatable", derandomize=True, deadline=None, database=None)
settings.load_profile("repeatable")


@pytest.fixture(scope="session", autouse=True)
def own_home(tmp_path_factory):
    """A place for the user's key that is no user's."""
    with pytest.MonkeyPatch.context() as patch:
        home = tmp_path_factory.mktemp("config")
        patch.setenv("XDG_CONFIG_HOME", str(home))
        yield home
