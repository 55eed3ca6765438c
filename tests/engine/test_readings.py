"""Readings of an engine, by name."""

from __future__ import annotations

from typing import Any

import pytest

from mbn_marl import BatchEngine
from mbn_marl.engine.readings import METRICS
from mbn_marl.errors import ConfigError


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (["sucess", "steps", 7], ["2 problems", "'sucess': unknown measure (did you mean success"]),
        (["sucess", "steps", 7], ["7: unknown measure; known: success, collision"]),
        ("success", ["1 problem", "names: 'success'; allowed: several of success, collision"]),
    ],
)
def test_unknown_measures_are_named(names: Any, words: list[str]) -> None:
    engine = BatchEngine("field_03", 2)
    engine.reset()
    with pytest.raises(ConfigError) as caught:
        engine.metrics(names)
    for word in words:
        assert word in str(caught.value)
    assert tuple(engine.metrics()) == METRICS
