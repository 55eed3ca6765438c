"""The subjects of a comparison, variants of algorithms, and what is compared, at equal budgets."""

import itertools
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, Field
from pydantic_core import to_jsonable_python
from tyro.conf import arg
from tyro.constructors import PrimitiveConstructorSpec

from baselines.training.config import TrainConfig, default_label, read_blocks, validate
from mbn_marl.errors import ConfigError, FieldError, collecting
from mbn_marl.field import FieldSampler, load_fields


class Variant(BaseModel, frozen=True, extra="forbid"):
    """A way to train; hyperparameters and environment are what differs from the recorded ones."""

    algorithm: str
    # C begins with another run: nothing to compare.
    setting: Literal["A", "B", "N", "J", "G"] = "N"
    label: str | None = None  # in tables; by default the algorithm's name
    hyperparameters: dict[str, Any] = Field(default_factory=dict)
    environment: dict[str, Any] = Field(default_factory=dict)
    # The run, or entry of the zoo, whose actor it begins with: --from of `mbn train`.
    transferred_from: Path | None = None

    @property
    def name(self) -> str:
        return self.label or default_label(self.algorithm, self.setting)

    def training(self, field: str, seed: int, **budget: Any) -> TrainConfig:
        return TrainConfig(field=field, seed=seed, **self.model_dump(), **budget)


def parse_variant(word: str) -> Variant:
    """Read a variant from ``ALGO``, or ``ALGO:SETTING`` for another setting than N.

    CompareConfig checks it: of an error here tyro would only say that there is one.
    """
    name, colon, setting = word.partition(":")
    return Variant.model_construct(algorithm=name, setting=setting if colon else "N")


Word = Annotated[
    Variant,
    PrimitiveConstructorSpec(
        nargs=1,
        metavar="ALGO",
        instance_from_str=lambda words: parse_variant(words[0]),
        is_instance=lambda value: isinstance(value, Variant),
        str_from_instance=lambda value: [f"{value.algorithm}:{value.setting}"],
    ),
]


def read_variants(path: Path) -> tuple[Variant, ...]:
    """Read variants from a YAML file, a block for each; a ConfigError names what is wrong."""
    return labelled(read_blocks(path), str(path))


def labelled(blocks: Mapping[str, Any], place: str) -> tuple[Variant, ...]:
    found, problems = list[Variant](), list[str]()
    for label, block in blocks.items():
        with collecting(problems):
            found.append(validate(Variant, {**block, "label": str(label)}, str(label)))
    if problems:
        raise ConfigError(place, problems)
    return tuple(found)


LEAST_STEPS, STEPS_PER_VISITOR = 655_360, 100_000


def proposed_steps(fields: Sequence[str]) -> int:
    """Return a budget for these fields in env-steps; errors as :func:`load_fields`."""
    sizes = [
        one.robots[1] * one.rois[1]
        if isinstance(one, FieldSampler)
        else len(one.starts) * len(one.rois)
        for one in map(load_fields, fields)
    ]
    return max([LEAST_STEPS, *(STEPS_PER_VISITOR * size for size in sizes)])


@dataclass(frozen=True)
class CompareConfig:
    """A comparison, and the options of `mbn compare`.

    Attributes:
        variants: algorithms of `mbn train`, centralised and decentralised together; crossq:A is
            crossq under setting A, crossq under N. By default two centralised and two
            decentralised ones with the same observations, training aids and budget; ppo:A is the
            paper's PPO.
        fields: names of `mbn fields`, or paths of field files; or random_convex, random_shapes or
            a sampler file, alone and with a tier.
        tier: the frozen fields that runs on random fields are evaluated on, such as 1-convex.
        seeds: one run per algorithm, field and seed.
        steps: the budget of every run in env-steps; by default 100,000 for each pair of a robot
            and an ROI of the largest field, and at least 655,360.
        evaluate_every: env-steps between two fresh evaluations.
        episodes: stochastic episodes of an evaluation.

    Raises:
        ConfigError: naming empty lists, what is there twice, and all that is wrong with a run.
    """

    variants: Annotated[tuple[Word, ...], arg(name="algos", metavar="ALGO ...")] = (
        Variant(algorithm="ppo", setting="J"),
        Variant(algorithm="ppo-joint"),
        Variant(algorithm="mappo"),
        Variant(algorithm="ippo"),
    )
    fields: tuple[str, ...] = ("field_03",)
    tier: str | None = None
    seeds: tuple[int, ...] = (0, 1, 2)
    steps: int = None  # type: ignore[assignment]  # replaced by the fields' own
    evaluate_every: int = 32_768
    episodes: int = 100

    def __post_init__(self) -> None:
        """Check everything before the first run starts; fill in the budget."""
        problems: list[str] = []
        with suppress(FieldError):  # the runs below name every field that is wrong
            if self.steps is None:
                object.__setattr__(self, "steps", proposed_steps(self.fields))
            random = [one for one in self.fields if isinstance(load_fields(one), FieldSampler)]
            if self.tier is None and random:
                problems.append(f"tier: {random[0]} is random fields, and needs one")
            if self.tier is not None and (len(random) != 1 or len(self.fields) != 1):
                problems.append("tier: allowed with one name of random fields, and no other field")
            places = (load_fields(one) for one in dict.fromkeys(self.fields))
            counted = Counter(one.name for one in places if not isinstance(one, FieldSampler))
            problems += [f"fields: two are named {one}" for one, k in counted.items() if k > 1]
        algorithms = [variant.name for variant in self.variants]
        lists = {"algorithms": algorithms, "fields": self.fields, "seeds": self.seeds}
        for name, values in lists.items():
            problems += [] if values else [f"{name}: at least one is needed"]
            counts: Counter[object] = Counter(values)
            problems += [f"{name}: {one} is given twice" for one in counts if counts[one] > 1]
        valid: list[Variant] = []
        for one in self.variants:
            with collecting(problems):
                validate(Variant, one.model_dump(warnings=False), one.algorithm)
                valid.append(one)
        names = []
        for cell in (cell for cell in self._cells() if cell[-1] in valid):
            with collecting(problems):
                names.append(self._run(*cell).name)
        if not problems and len(set(names)) < len(names):
            problems.append("fields: two files have the same name")
        if problems:
            raise ConfigError("comparison", problems)

    def runs(self) -> list[TrainConfig]:
        return [self._run(*cell) for cell in self._cells()]

    def _cells(self) -> Iterator[tuple[int, str, Variant]]:
        return itertools.product(self.seeds, self.fields, self.variants)

    def _run(self, seed: int, field: str, variant: Variant) -> TrainConfig:
        names = ("steps", "evaluate_every", "episodes", "tier")
        budget = {name: getattr(self, name) for name in names}
        return variant.training(field, seed, **budget)

    def to_json(self) -> dict[str, Any]:
        values: dict[str, Any] = to_jsonable_python(self)
        return values
