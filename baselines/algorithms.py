"""The registry of algorithms; their libraries are imported when they are used."""

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

from mbn_marl.errors import MbnError, unknown

Form = Literal["centralized", "decentralized"]
Setting = Literal["A", "B", "C", "N", "J", "G"]


@dataclass(frozen=True)
class Protocol:
    # A setting in a few words, and the seed and the budget in env-steps of its runs.
    summary: str
    seed: int = 0
    steps: int = 655_360


SETTINGS: Mapping[Setting, Protocol] = {
    "A": Protocol("the paper's: library defaults, raw observation and reward", 33, 5_000_000),
    "B": Protocol("the paper's: as A, with its Optuna values", 33, 5_000_000),
    "C": Protocol("the paper's: as A, from a policy trained on another field", 33, 5_000_000),
    "N": Protocol("normalised observation, scaled reward; CrossQ has raw ones"),
    "J": Protocol("as N, with the observations and training aids of ppo-joint"),
    "G": Protocol("one policy for every field: a network over sets, shaped reward"),
}


@dataclass(frozen=True)
class Algorithm:
    name: str
    # "centralized": the single MDP. "decentralized": each robot acts on its own observation.
    form: Form
    # The package of baselines that trains it: sb3 or torchrl.
    package: str
    settings: tuple[Setting, ...] = ("N",)

    def _module(self, name: str) -> ModuleType:
        return import_module(f"baselines.{self.package}.{name}")

    def resolve(
        self, overrides: Mapping[str, Any], *, setting: Setting = "N", **options: Any
    ) -> Any:
        """Return the recorded hyperparameters with ``overrides``; a ConfigError names all wrong."""
        # Of the options ``num_envs`` replaces the number of worlds side by side, and the block of
        # the setting in the YAML ``file`` the recorded block.
        return self._module("config").load(self.name, setting, overrides, **options)

    @property
    def trainer(self) -> Any:
        """The module whose ``check``, ``budget`` and ``train`` take a task and hyperparameters."""
        return self._module("trainer")

    def load_policy(self, folder: Path) -> Any:
        return self._module("policy").load_policy(folder)


PAPER: tuple[Setting, ...] = ("A", "B", "C", "N")
ALGORITHMS: Mapping[str, Algorithm] = {
    algorithm.name: algorithm
    for algorithm in (
        Algorithm("a2c", "centralized", "sb3", PAPER),
        Algorithm("ppo", "centralized", "sb3", (*PAPER, "J")),
        Algorithm("trpo", "centralized", "sb3", (*PAPER, "J")),
        Algorithm("ars", "centralized", "sb3", PAPER),
        Algorithm("crossq", "centralized", "sb3", PAPER),
        Algorithm("crossq-sbx", "centralized", "sb3"),
        Algorithm("tqc", "centralized", "sb3", PAPER),
        Algorithm("mappo", "decentralized", "torchrl", ("N", "G")),
        Algorithm("ippo", "decentralized", "torchrl", ("N", "G")),
        Algorithm("ppo-joint", "centralized", "torchrl", ("N", "G")),
        Algorithm("ppo-shared", "decentralized", "sb3"),
    )
}


def find_algorithm(name: str) -> Algorithm:
    """Look up an algorithm; raise an MbnError that lists the known ones."""
    if name not in ALGORITHMS:
        raise MbnError(f"{name}: {unknown('algorithm', name, ALGORITHMS)}")
    return ALGORITHMS[name]
