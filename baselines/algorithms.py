"""The registry of algorithms: frozen entries that import their libraries when they are used."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from types import ModuleType
from typing import Any, Literal

from mbn_marl.errors import MbnError

Form = Literal["centralized", "decentralized"]


@dataclass(frozen=True)
class Algorithm:
    """One algorithm.

    Attributes:
        name: as on the command line.
        form: ``"centralized"``, the single MDP with Stable-Baselines3, or ``"decentralized"``,
            one policy per robot with TorchRL. Each form is one package with one trainer.
    """

    name: str
    form: Form

    def _module(self, name: str) -> ModuleType:
        return import_module(f"baselines.{self.form}.{name}")

    def resolve(self, overrides: Mapping[str, Any]) -> Any:
        """The hyperparameters: the recorded ones with ``overrides``.

        Raises:
            ConfigError: naming every unknown or invalid hyperparameter.
        """
        return self._module("config").load(self.name, overrides)

    @property
    def train(self) -> Callable[..., None]:
        """``train(task, hyperparameters, recorder)``."""
        train: Callable[..., None] = self._module("trainer").train
        return train

    @property
    def load_policy(self) -> Callable[..., Any]:
        """``load_policy(run_folder)``."""
        load: Callable[..., Any] = self._module("policy").load
        return load


ALGORITHMS: Mapping[str, Algorithm] = {
    algorithm.name: algorithm
    for algorithm in (
        Algorithm("ppo", "centralized"),
        Algorithm("mappo", "decentralized"),
        Algorithm("ippo", "decentralized"),
    )
}


def find_algorithm(name: str) -> Algorithm:
    """Look up an algorithm.

    Raises:
        MbnError: the name is unknown; the message lists the known ones.
    """
    if name not in ALGORITHMS:
        raise MbnError(f"unknown algorithm {name!r}; known: {', '.join(ALGORITHMS)}")
    return ALGORITHMS[name]
