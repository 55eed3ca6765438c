"""A training run: the request as given, and as a trainer gets it."""

from __future__ import annotations

import dataclasses
import math
import re
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from tyro.conf import Positional, Suppress, arg

from baselines.algorithms import SETTINGS, Setting, find_algorithm
from baselines.training.overrides import ENVIRONMENT, words_of
from mbn_marl.errors import ConfigError, MbnError, collecting
from mbn_marl.field import Field, FieldSampler, load_fields

LABEL = re.compile(r"[A-Za-z0-9][\w.+-]*")
"""Labels name folders too."""

MOST = 10**15
MOST_SEED = 2**32 - 1
"""NumPy's global generator takes no larger seed."""
RANGES = {
    "seed": (0, MOST_SEED),
    **{"steps": (1, MOST), "evaluate_every": (1, MOST), "episodes": (1, MOST)},
    "num_envs": (1, MOST),
}
"""The least and the greatest value of the numbers of a request."""


class DivergenceError(MbnError):
    """A learner diverged: its numbers are no longer finite."""


@dataclass(frozen=True)
class TrainConfig:
    """A training run: what is asked of it, and the options of `mbn train`.

    Attributes:
        algorithm: a2c, ppo, trpo, ars, crossq, tqc, ppo-joint (centralised); mappo, ippo,
            generalist, ppo-shared and ppo-supersuit (decentralised).
        field: a name of `mbn fields`, or the path of a field file; generalist, and mappo and
            ippo with network=entities, take random_convex, random_shapes and sampler files too.
        setting: A: the paper's library defaults, raw observation and reward. B: its Optuna values.
            C: as A, from a policy trained on another field. N: normalised observation, scaled
            reward. J (ppo, trpo): as N, with the observations and training aids of ppo-joint.
        seed: of networks, exploration and worlds, 0 to 2^32 - 1; by default 33 under A, B and C, 0
            under N and J.
        steps: the budget in env-steps (an env-step moves every robot of one world once), rounded up
            to whole updates; by default 5,000,000 under A, B and C, 655,360 under N and J.
        evaluate_every: env-steps between two fresh evaluations; after each one a checkpoint is
            written.
        episodes: stochastic episodes of an evaluation.
        stop_at: stop before the end of the budget, at the first fresh evaluation with this mean
            return (reward) and 99 % success, if all episodes with mean actions succeed too.
        num_envs: worlds stepped side by side; by default 1 under A, B and C, the recorded number
            under N.
        hyperparams: a YAML file whose block named as the setting replaces the recorded one.
        transferred_from: the folder of the run whose policy it begins with. Under C networks and
            optimisers, `mbn transfer` does it all; mappo, ippo, ppo-joint and generalist take the
            actor's network, also of the zoo (zoo:NAME), whose field may be another one.
        device: where the networks run, and under mappo, ippo, ppo-joint and generalist the worlds
            too; of the others, worth it for crossq and tqc.
        label: the name in tables and figures, and of the folder; by default the algorithm.
        environment: settings of the environment that differ from the algorithm's own.
        hyperparameters: hyperparameters that differ from the algorithm's own.

    Raises:
        ConfigError: naming every number out of range, and an algorithm, setting or field that is
            not there.
    """

    algorithm: Positional[Annotated[str, arg(metavar="ALGO")]]
    field: Positional[Annotated[str, arg(metavar="FIELD")]]
    setting: Setting = "N"
    seed: int = None  # type: ignore[assignment]  # replaced by the setting's own
    steps: int = None  # type: ignore[assignment]
    evaluate_every: int = 32_768
    episodes: int = 100
    stop_at: float | None = None
    num_envs: int | None = None
    hyperparams: Path | None = None
    transferred_from: Annotated[Path | None, arg(name="from", metavar="RUN")] = None
    device: Literal["cpu", "cuda"] = "cpu"
    label: str | None = None
    environment: Suppress[Mapping[str, Any]] = dataclasses.field(default_factory=dict)
    hyperparameters: Suppress[Mapping[str, Any]] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        """Fill in the setting's own numbers; check the numbers and the names."""
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
        """The run's name, unique in a comparison: label or algorithm and setting; field; seed."""
        several = len(find_algorithm(self.algorithm).settings) > 1
        learner = f"{self.algorithm}-{self.setting}" if several else self.algorithm
        return f"{self.label or learner}-{Path(self.field).stem}-seed{self.seed}"

    @property
    def shown_as(self) -> str:
        """The name in tables and figures."""
        return self.label or default_label(self.algorithm, self.setting)

    @property
    def command(self) -> str:
        """The command line that repeats this run."""
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
    problems: list[str] = []
    for name, (least, most) in RANGES.items():
        value = request.get(name)
        if not (value is None or (isinstance(value, int) and not isinstance(value, bool))):
            problems.append(f"{name}: must be a whole number (got {value!r})")
        elif value is not None and not least <= value <= most:
            problems.append(f"{name}: must be at least {least}, at most {most} (got {value})")
    stop_at, label = request.get("stop_at"), request.get("label")
    if not (stop_at is None or (isinstance(stop_at, float | int) and math.isfinite(stop_at))):
        problems.append(f"stop_at: must be finite (got {stop_at!r})")
    if not (label is None or (isinstance(label, str) and LABEL.fullmatch(label))):
        allowed = "letters, digits, _ . + -, the first a letter or digit"
        problems.append(f"label: {label!r}; allowed: {allowed}")
    if not isinstance(request.get("field"), str):
        problems.append(f"field: must be a name or a path (got {request.get('field')!r})")
    for name in ("environment", "hyperparameters"):
        if not isinstance(value := request.get(name, {}), Mapping):
            problems.append(f"{name}: must be a mapping (got {value!r})")
    return problems + _setting_problems(request)


def _setting_problems(request: Mapping[str, Any]) -> list[str]:
    """Return what is wrong with the algorithm, its setting, and what it begins with."""
    name, setting = str(request.get("algorithm")), request.get("setting")
    begins = request.get("transferred_from")
    try:
        algorithm = find_algorithm(name)
    except MbnError as error:
        return [str(error)]
    if setting not in algorithm.settings:
        return [f"setting: {name} has {', '.join(algorithm.settings)}, not {setting}"]
    if setting == "C" and begins is None:
        return ["setting: C continues from a trained policy; name it with --from"]
    if setting != "C" and begins is not None and algorithm.package == "sb3":
        others = "for mappo, ippo, ppo-joint and generalist"
        return [f"from: allowed under setting C, not {setting}, and {others}"]
    return []


def default_label(algorithm: str, setting: str) -> str:
    """Return the name in tables and figures of a run without a label; setting N is left out."""
    return algorithm if setting == "N" else f"{algorithm}-{setting}"


class Budget(NamedTuple):
    """The env-steps of a run, rounded up to the ``unit`` in words that its algorithm learns from.

    If it is not ``exact``, ``env_steps`` is the most that the run may take.
    """

    env_steps: int
    unit: str
    exact: bool = True


@dataclass(frozen=True)
class Task:
    """A request with its field loaded, or the sampler of its fields, as a trainer gets it.

    ``settings`` are keyword arguments of the environment: the algorithm's own and the request's.
    """

    config: TrainConfig
    field: Field | FieldSampler
    settings: Mapping[str, Any]
