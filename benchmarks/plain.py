"""The plain per-robot loop: the tests' oracle, which steps one world in Python and NumPy."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

from benchmarks.stepping import RandomSteps
from benchmarks.timing import Case
from mbn_marl import load_field

ORACLE = Path(__file__).parents[1] / "tests" / "support" / "oracle.py"
"""The tests are not installed: only a checkout has this file."""


class PlainLoop:
    """One world of the oracle, that starts anew whenever its episode ends.

    It does what the engine does in a step: revisit memory, rewards and their terms, metrics, and
    an observation for each robot.

    Attributes:
        observations: (n,) arrays, the robots' current ones.
        metrics: of the last episode that ended.
    """

    def __init__(self, oracle: Any) -> None:
        self._oracle = oracle
        self.observations: list[Any] = []
        self.metrics: dict[str, Any] = {}

    def step(self, actions: Any) -> None:
        """Step with ``actions`` (n, 2)."""
        outcome = self._oracle.step(actions.tolist())
        if outcome.terminated or outcome.truncated:
            self.metrics = self._oracle.metrics()
            self._oracle.reset()
        self.observations = [self._oracle.observe(robot) for robot in range(self._oracle.n)]


def plain_cases() -> list[Case]:
    """The loop on field_01 as a case, in seconds per env-step; none without a checkout."""
    if not ORACLE.is_file():
        return []
    oracle = _module("mbn_marl_oracle", ORACLE).Oracle(load_field("field_01"))
    return [RandomSteps((oracle.n, 2), PlainLoop(oracle).step).case("plain loop", 1.0)]


def _module(name: str, path: Path) -> Any:
    """The module in the file ``path``, imported under ``name``."""
    if name not in sys.modules:
        spec = importlib.util.spec_from_file_location(name, path)
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module  # dataclasses look there
        spec.loader.exec_module(module)
    return sys.modules[name]
