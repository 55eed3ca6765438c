"""The search space of an algorithm: the paper's hyperparameters and ranges."""

from __future__ import annotations

from typing import Any, NamedTuple

from optuna import Trial

from baselines.algorithms import find_algorithm
from baselines.paper import published
from baselines.sb3.config import accepted_arguments
from mbn_marl.errors import MbnError

LOGARITHMIC = {"learning_rate"}
"""Drawn so that each decade is as likely; the paper does not say how it drew."""


class Space(NamedTuple):
    """The hyperparameters that are tuned for an algorithm.

    Attributes:
        ranges: the lowest and the highest value of each, in the paper's order.
        skipped: what the paper tuned but the library's class does not take.
    """

    ranges: dict[str, tuple[float, float]]
    skipped: tuple[str, ...]

    @classmethod
    def of(cls, algorithm: str) -> Space:
        """The paper's space for ``algorithm``.

        Raises:
            MbnError: the paper did not tune it; the message lists what it tuned.
        """
        find_algorithm(algorithm)
        if algorithm not in published.ALGORITHMS:
            known = ", ".join(published.ALGORITHMS)
            raise MbnError(f"{algorithm} has no ranges to tune it in; those that have: {known}")
        ranges, accepted = published.tuning_ranges(algorithm), accepted_arguments(algorithm)
        return cls(
            {name: ends for name, ends in ranges.items() if name in accepted},
            tuple(name for name in ranges if name not in accepted),
        )

    def suggest(self, trial: Trial) -> dict[str, Any]:
        """A value for each hyperparameter; one whose ends are whole numbers above 1 is whole."""
        values: dict[str, float] = {}
        for name, (low, high) in self.ranges.items():
            if low > 1 and low % 1 == high % 1 == 0:
                values[name] = trial.suggest_int(name, int(low), int(high))
            else:
                values[name] = trial.suggest_float(name, low, high, log=name in LOGARITHMIC)
        return values
