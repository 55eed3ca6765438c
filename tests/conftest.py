"""Settings of the whole test run."""

import os

from hypothesis import settings

# Threads that spin while they wait take the cores from the tests that run beside them.
os.environ |= {"OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "passive"}
os.environ["SDL_VIDEODRIVER"] = "dummy"  # windows that nobody sees

pytest_plugins = ["tests.support.configurations"]

# Derandomised, so that a red run is red for everybody; no deadline, since a first example compiles.
settings.register_profile("repeatable", derandomize=True, deadline=None, database=None)
settings.load_profile("repeatable")
