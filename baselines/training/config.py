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

MOST_SEED = 2**32 - 1
"""NumPy's global generator takes no larger seed."""


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
            reward.
        seed: of networks, exploration and worlds, 0 to 2^32 - 1; by default 33 under A, B and C, 0
            under N.
        steps: the budget in env-steps (an env-step moves every robot of one world once), rounded up
            to whole updates; by default 5,000,000 under A, B and C, 655,360 under N.
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
        least = {"seed": 0, "steps": 1, "evaluate_every": 1, "episodes": 1, "num_envs": 1}
        problems = [
            f"{name}: must be at least {bound} (got {value})"
            for name, bound in least.items()
            if (value := getattr(self, name)) is not None and value < bound
        ]
        if self.stop_at is not None and not math.isfinite(self.stop_at):
            problems.append(f"stop_at: must be finite (got {self.stop_at})")
        if self.seed > MOST_SEED:
            problems.append(f"seed: must be at most 2^32 - 1 (got {self.seed})")
        if self.label is not None and not LABEL.fullmatch(self.label):
            problems.append(
                f"label: {self.label!r}; allowed: letters, digits, _ . + -, the first a letter "
                "or digit"
            )
        with collecting(problems):
            algorithm = find_algorithm(self.algorithm)
            allowed, of_sb3 = algorithm.settings, algorithm.package == "sb3"
            if self.setting not in allowed:
                has = ", ".join(allowed)
                problems.append(f"setting: {self.algorithm} has {has}, not {self.setting}")
            elif self.setting == "C" and self.transferred_from is None:
                problems.append("setting: C continues from a trained policy; name it with --from")
            elif self.setting != "C" and self.transferred_from is not None and of_sb3:
                problems.append(
                    f"from: allowed under setting C, not {self.setting}, and for mappo, ippo, "
                    "ppo-joint and generalist"
                )
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
