"""Settings of the whole test run."""

from __future__ import annotations

from hypothesis import settings

# Derandomised, so that a red run is red for everybody; no deadline, since a first example compiles.
settings.register_profile("repeatable", derandomize=True, deadline=None, database=None)
settings.load_profile("repeatable")
