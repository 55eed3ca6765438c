"""The parts of a comparison: variants on fields with several seeds, at equal budgets."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any

from pydantic_core import to_jsonable_python
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
            twice = [value for value, count in Counter(values).items() if count > 1]
            problems += [f"{name}: {value} is given twice" for value in twice]
        names = []
        for request in self._requests():
            with collecting(problems):
                names.append(request().name)
        if not problems and len(set(names)) < len(names):
            problems.append("fields: two files have the same name")
        if problems:
            raise ConfigError("comparison", problems)

    def runs(self) -> list[TrainConfig]:
        """Return the runs, seed by seed."""
        return [request() for request in self._requests()]

    def _requests(self) -> list[Callable[[], TrainConfig]]:
        budget = {name: getattr(self, name) for name in ("steps", "evaluate_every", "episodes")}
        cells = itertools.product(self.seeds, self.fields, self.variants)
        return [partial(variant.training, field, seed, **budget) for seed, field, variant in cells]

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON values."""
        values: dict[str, Any] = to_jsonable_python(self)
        return values
