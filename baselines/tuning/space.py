"""The search space of an algorithm: the paper's hyperparameters and ranges."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

from optuna import Trial

from baselines.algorithms import find_algorithm
from baselines.paper import published
from baselines.sb3.config import accepted_arguments
from mbn_marl.errors import MbnError

LOGARITHMIC = {"learning_rate"}
"""Drawn so that each decade is as likely; the paper does not say how it drew."""


class Parameter(NamedTuple):
    """A hyperparameter and its range; one whose ends are whole numbers above 1 is whole."""

    name: str
    low: float
    high: float

    def suggest(self, trial: Trial) -> float:
        """A value for ``trial``."""
        if self.low > 1 and self.low % 1 == self.high % 1 == 0:
            return trial.suggest_int(self.name, int(self.low), int(self.high))
        log = self.name in LOGARITHMIC
        return trial.suggest_float(self.name, self.low, self.high, log=log)


@dataclass(frozen=True)
class Space:
    """The hyperparameters that are tuned for an algorithm.

    Attributes:
        parameters: in the paper's order.
        skipped: what the paper tuned but the library's class does not take.
    """

    parameters: tuple[Parameter, ...]
    skipped: tuple[str, ...]

    @classmethod
    def of(cls, algorithm: str) -> Space:
        """The paper's space for ``algorithm``.

        Raises:
            MbnError: the paper did not tune it; the message lists what it tuned.
        """
        find_algorithm(algorithm)
        if algorithm not in published.algorithms():
            known = ", ".join(published.algorithms())
            raise MbnError(f"{algorithm} has no ranges to tune it in; those that have: {known}")
        names = list(published.tuned(algorithm))
        accepted = accepted_arguments(algorithm)
        return cls(
            tuple(
                Parameter(name, *published.tuning_range(name)) for name in names if name in accepted
            ),
            tuple(name for name in names if name not in accepted),
        )

    def suggest(self, trial: Trial) -> dict[str, Any]:
        """A value for each hyperparameter, by name."""
        return {parameter.name: parameter.suggest(trial) for parameter in self.parameters}
