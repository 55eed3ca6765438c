"""A training run: the request, its hyperparameters, and what a trainer gets."""

import dataclasses
import json
import re
import shlex
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar, cast

import pydantic
from pydantic_core import to_jsonable_python
from tyro.conf import Positional, Suppress, arg

from baselines.algorithms import SETTINGS, Setting, find_algorithm
from mbn_marl.config import describe
from mbn_marl.errors import ConfigError, FieldError, MbnError, collecting, unknown
from mbn_marl.field import Field, FieldSampler, load_fields
from mbn_marl.field.files import parse_yaml
from mbn_marl.field.splits import SEARCH, TIERS

# Overrides that begin with this and a point are settings of the environment.
ENVIRONMENT = "environment"
# Labels name folders too.
LABEL = re.compile(r"[A-Za-z0-9][\w.+-]*")
MOST = 10**15
# NumPy's global generator takes no larger seed.
MOST_SEED = 2**32 - 1
# The least and the greatest value of the numbers of a request.
RANGES = {
    "seed": (0, MOST_SEED),
    **dict.fromkeys(("steps", "evaluate_every", "episodes", "num_envs"), (1, MOST)),
}


class DivergenceError(MbnError):
    """A learner diverged: its numbers are no longer finite."""


@dataclass(frozen=True)
class TrainConfig:
    """A training run: what is asked of it, and the options of `mbn train`."""

    # One of a2c, ppo, trpo, ars, crossq, crossq-sbx, tqc, ppo-joint (centralised); mappo, ippo,
    # ppo-shared (decentralised).
    algorithm: Positional[Annotated[str, arg(metavar="ALGO")]]
    # A name of `mbn fields`, or the path of a field file; setting G, or network=entities, takes
    # random_convex, random_shapes and sampler files too.
    field: Positional[Annotated[str, arg(metavar="FIELD")]]
    # A: the paper's library defaults, raw observation and reward. B: its Optuna values. C: as A,
    # from a policy trained on another field. N: normalised observation, scaled reward. J (ppo,
    # trpo): as N, with the observations and training aids of ppo-joint. G (mappo, ippo, ppo-joint):
    # one policy for every field, a network over sets.
    setting: Setting = "N"
    # Of networks, exploration and worlds, 0 to 2^32 - 1; by default 33 under A, B and C, 0 under
    # the others.
    seed: int = cast("int", None)
    # The budget in env-steps (an env-step moves every robot of one world once), rounded up to whole
    # updates; by default 5,000,000 under A, B and C, 655,360 under the others.
    steps: int = cast("int", None)
    # Env-steps between two fresh evaluations; after each one a checkpoint is written.
    evaluate_every: int = 32_768
    # Stochastic episodes of an evaluation.
    episodes: int = 100
    # For random fields: evaluate on the frozen fields of this tier of the benchmark, on the way on
    # those of the split validation, at the end on those of test. 6-search fixes settings of the
    # environment too; its comm_radius is to be given.
    tier: str | None = None
    # Worlds stepped side by side; by default the setting's number.
    num_envs: int | None = None
    # A YAML file whose block named as the setting replaces the recorded one.
    hyperparams: Path | None = None
    # The folder of the run whose policy it begins with. Under C networks and optimisers, `mbn
    # transfer` does it all; mappo, ippo and ppo-joint take the actor's network, also of the zoo
    # (zoo:NAME), whose field may be another one.
    transferred_from: Annotated[Path | None, arg(name="from", metavar="RUN")] = None
    # The networks run there, and under mappo, ippo and ppo-joint the worlds too; of the others,
    # worth it for crossq and tqc.
    device: Literal["cpu", "cuda"] = "cpu"
    # The name in tables and figures, and of the folder; by default the algorithm.
    label: str | None = None
    # Settings of the environment that differ from the algorithm's own.
    environment: Suppress[Mapping[str, Any]] = dataclasses.field(default_factory=dict)
    # Hyperparameters that differ from the algorithm's own.
    hyperparameters: Suppress[Mapping[str, Any]] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        # The setting's own seed and budget, where none is given.
        protocol = SETTINGS.get(self.setting, SETTINGS["N"])
        for name in ("seed", "steps"):
            if getattr(self, name) is None:
                object.__setattr__(self, name, getattr(protocol, name))
        problems = problems_of(vars(self))
        with collecting(problems):
            load_fields(self.field)
        if problems:
            raise ConfigError("training", problems)

    @property
    def name(self) -> str:
        centralized = "A" in find_algorithm(self.algorithm).settings
        learner = f"{self.algorithm}-{self.setting}" if centralized else self.shown_as
        return f"{self.label or learner}-{Path(self.field).stem}-seed{self.seed}"

    @property
    def shown_as(self) -> str:
        return self.label or default_label(self.algorithm, self.setting)

    @property
    def command(self) -> str:
        words: list[str] = []
        for field in dataclasses.fields(self)[2:-2]:
            name = "from" if field.name == "transferred_from" else field.name.replace("_", "-")
            if (value := getattr(self, field.name)) is not None:
                words += [f"--{name}", str(value)]
        environment = {ENVIRONMENT: self.environment} if self.environment else {}
        if changes := words_of({**self.hyperparameters, **environment}):
            words += ["--set", *changes]
        return shlex.join(["mbn", "train", self.algorithm, self.field, *words])


def problems_of(request: Mapping[str, Any]) -> list[str]:
    """Return what is wrong with the entries of a request, given or recorded, but for its field."""
    problems = [
        f"{name}: must be a whole number, at least {least}, at most {most} (got {value!r})"
        for name, (least, most) in RANGES.items()
        if (value := request.get(name)) is not None
        and not (type(value) is int and least <= value <= most)
    ]
    label = request.get("label")
    if not (label is None or (isinstance(label, str) and LABEL.fullmatch(label))):
        allowed = "letters, digits, _ . + -, the first a letter or digit"
        problems.append(f"label: {label!r}; allowed: {allowed}")
    tiers = *TIERS, SEARCH
    if request.get("tier") not in (None, *tiers):
        problems.append(f"tier: {unknown('tier', str(request.get('tier')), tiers)}")
    if not isinstance(request.get("field"), str):
        problems.append(f"field: must be a name or a path (got {request.get('field')!r})")
    for name in ("environment", "hyperparameters"):
        if not isinstance(value := request.get(name, {}), Mapping):
            problems.append(f"{name}: must be a mapping (got {value!r})")
    name, setting = str(request.get("algorithm")), request.get("setting")
    begins = request.get("transferred_from") is not None
    with collecting(problems):
        algorithm = find_algorithm(name)
        if setting not in algorithm.settings:
            problems.append(f"setting: {name} has {', '.join(algorithm.settings)}, not {setting}")
        elif setting == "C" and not begins:
            problems.append("setting: C continues from a trained policy; name it with --from")
        elif setting != "C" and begins and algorithm.package == "sb3":
            others = "for mappo, ippo and ppo-joint"
            problems.append(f"from: allowed under setting C, not {setting}, and {others}")
        if name == "crossq-sbx" and request.get("device") == "cuda":
            problems.append("device: JAX chooses that of crossq-sbx; allowed: cpu")
    return problems


def default_label(algorithm: str, setting: str) -> str:
    return algorithm if setting == "N" else f"{algorithm}-{setting}"


class Hyperparameters(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    # The origin of the numbers.
    source: str = pydantic.Field("", repr=False)
    # The algorithm's own settings of the environment.
    environment: dict[str, Any] = pydantic.Field(default_factory=dict)
    # At most so many learners begin one after the other. Each has an equal part of the budget, of
    # 655,360 env-steps at least, and continues if no policy is perfect then. The best policy of all
    # counts: a team settles early, and at random, on the order in which it visits ROIs.
    learners: Annotated[int, pydantic.Field(ge=1)] = 1
    # Values of the source that the algorithm has no argument for; without effect.
    skipped: dict[str, Any] = pydantic.Field(default_factory=dict, repr=False)


Model = TypeVar("Model", bound=pydantic.BaseModel)


def read_yaml(path: Path) -> dict[str, Any]:
    try:
        content = parse_yaml(path.read_bytes(), str(path))
    except FieldError as error:
        raise ConfigError(str(path), error.problems) from None
    except OSError as error:
        raise ConfigError(str(path), [f"cannot be read: {error}"]) from None
    if not isinstance(content, dict):
        raise ConfigError(str(path), ["must be a mapping"])
    return content


def read_blocks(path: Path) -> dict[str, Any]:
    blocks = read_yaml(path)
    if problems := [
        f"{name}: must be a mapping (got {one!r})"
        for name, one in blocks.items()
        if not isinstance(one, dict)
    ]:
        raise ConfigError(str(path), problems)
    return blocks


def read_block(path: Path, name: str) -> dict[str, Any]:
    blocks = read_blocks(path)
    if name not in blocks:
        raise ConfigError(str(path), [f"{name}: {unknown('block', name, map(str, blocks))}"])
    return dict(blocks[name])


def merged(values: Any, changes: Any) -> Any:
    """Return mappings with changes in their place, at every depth; other values are replaced."""
    if not (isinstance(values, Mapping) and isinstance(changes, Mapping)):
        return changes
    return {**values, **{name: merged(values.get(name), one) for name, one in changes.items()}}


def validate(model: type[Model], values: Mapping[str, Any], source: str) -> Model:
    try:
        return model.model_validate(dict(values))
    except pydantic.ValidationError as error:
        raise ConfigError(source, describe(error, model)) from None


def parse(words: Sequence[str]) -> dict[str, Any]:
    """Read words: ``["model.gamma=0.9", "a=b"]`` is ``{"model": {"gamma": 0.9}, "a": "b"}``."""
    values: dict[str, Any] = {}
    problems = []
    for word in words:
        name, equals, text = word.partition("=")
        *path, last = name.split(".")
        if not equals or not all([*path, last]):
            problems.append(f"{word}: must be NAME=VALUE, for example model.gamma=0.9")
            continue
        place: Any = values
        for part in path:
            place = place.setdefault(part, {}) if isinstance(place, dict) else None
        if not isinstance(place, dict) or last in place:
            problems.append(f"{word}: {name} is set twice")
            continue
        place[last] = _value(text)
    if not isinstance(values.get(ENVIRONMENT, {}), dict):
        problems.append(f"{ENVIRONMENT}: must be {ENVIRONMENT}.NAME=VALUE")
    if problems:
        raise ConfigError("set", problems)
    return values


def words_of(values: Mapping[str, Any]) -> list[str]:
    words = []
    for name, value in to_jsonable_python(dict(values)).items():
        if isinstance(value, Mapping) and value:
            words += [f"{name}.{word}" for word in words_of(value)]
        else:
            is_word = isinstance(value, str) and _value(value) == value
            words.append(f"{name}={value if is_word else json.dumps(value)}")
    return words


def _value(text: str) -> Any:
    for read in (json.loads, float):  # inf and nan are numbers, but no JSON
        with suppress(ValueError):
            return read(text)
    return text


class Budget(NamedTuple):
    env_steps: int
    unit: str
    # If not, ``env_steps`` is the most that the run may take.
    exact: bool = True


@dataclass(frozen=True)
class Task:
    config: TrainConfig
    field: Field | FieldSampler
    # Keyword arguments of the environment: the algorithm's own and the request's.
    settings: Mapping[str, Any]

    def field_of(self, seed: int) -> Field | FieldSampler:
        """Return the field, or the random fields of a run with another seed."""
        if isinstance(self.field, Field):
            return self.field
        number = (self.field.seed + seed - self.config.seed) % 2**63
        return self.field.model_copy(update={"seed": number})
