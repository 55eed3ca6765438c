"""A stand-in for CoppeliaSim."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.support.coppelia_server import CoppeliaServer


@pytest.fixture
def server() -> Iterator[CoppeliaServer]:
    with CoppeliaServer() as running:
        yield running
