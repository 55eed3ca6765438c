"""The parts of a comparison: variants on fields with several seeds, at equal budgets."""

from __future__ import annotations

import itertools
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

from tyro.conf import arg

from baselines.compare.variants import Variant
from baselines.training.config import TrainConfig
from mbn_marl.errors import ConfigError, collecting


@dataclass(frozen=True)
class CompareConfig:
    """A comparison, and the options of `mbn compare`.

    Attributes:
        variants: algorithms of `mbn train`, centralised and decentralised together; crossq:A is
            crossq under setting A, crossq under N.
        fields: names of `mbn fields`, or paths of field files.
        seeds: one run per algorithm, field and seed.
        steps: the budget of every run in env-steps.
        evaluate_every: env-steps between two fresh evaluations.
        episodes: stochastic episodes of an evaluation.

    Raises:
        ConfigError: naming each list that is empty or has something twice, two field files with the
            same name, and all that is wrong with a run.
    """

    variants: Annotated[tuple[Variant, ...], arg(name="algos", metavar="ALGO ...")] = (
        Variant(algorithm="ppo"),
        Variant(algorithm="mappo"),
        Variant(algorithm="ippo"),
    )
    fields: tuple[str, ...] = ("field_03",)
    seeds: tuple[int, ...] = (0, 1, 2)
    steps: int = 655_360
    evaluate_every: int = 32_768
    episodes: int = 100

    def __post_init__(self) -> None:
        """Check everything before the first run starts."""
        problems = []
        lists: dict[str, Sequence[Any]] = {
            "algorithms": [variant.name for variant in self.variants],
            "fields": self.fields,
            "seeds": self.seeds,
        }
        for name, values in lists.items():
            if not values:
                problems.append(f"{name}: at least one is needed")
            problems += [
                f"{name}: {value} is given twice"
                for value in dict.fromkeys(values)
                if values.count(value) > 1
            ]
        names = []
        for seed, field, variant in self._cells():
            with collecting(problems):
                names.append(self._run(seed, field, variant).name)
        if not problems and len(set(names)) < len(names):
            problems.append("fields: two files have the same name")
        if problems:
            raise ConfigError("comparison", problems)

    def runs(self) -> list[TrainConfig]:
        """Return the runs, seed by seed."""
        return [self._run(*cell) for cell in self._cells()]

    def _cells(self) -> list[tuple[int, str, Variant]]:
        return list(itertools.product(self.seeds, self.fields, self.variants))

    def _run(self, seed: int, field: str, variant: Variant) -> TrainConfig:
        budget = {name: getattr(self, name) for name in ("steps", "evaluate_every", "episodes")}
        return variant.training(field, seed, **budget)

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON values."""
        values = {**vars(self), "variants": [variant.model_dump() for variant in self.variants]}
        as_json: dict[str, Any] = json.loads(json.dumps(values))
        return as_json
