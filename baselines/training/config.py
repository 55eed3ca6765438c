"""What is asked of a training run: the request as given, and as a trainer gets it."""

from __future__ import annotations

import dataclasses
import re
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

from baselines.algorithms import Setting, find_algorithm
from baselines.training.overrides import ENVIRONMENT, words_of
from mbn_marl.errors import ConfigError, MbnError
from mbn_marl.field import Field, load_field

LABEL = re.compile(r"[A-Za-z0-9][\w.+-]*")
"""Labels name folders too."""

MOST_SEED = 2**32 - 1
"""NumPy's global generator takes no larger seed."""


class DivergenceError(MbnError):
    """A learner broke down in training."""


@dataclass(frozen=True)
class TrainConfig:
    """What a training run is asked to do.

    Attributes:
        algorithm: a name of :data:`baselines.algorithms.ALGORITHMS`.
        field: a catalogue name or the path of a field file.
        setting: a name of :data:`baselines.algorithms.SETTINGS` that the algorithm has.
        seed: seeds the networks, the exploration and the worlds (0 to 2^32 - 1).
        steps: the budget in env-steps (> 0), rounded up to whole updates of the learner.
        evaluate_every: env-steps between two fresh evaluations (> 0).
        episodes: stochastic episodes of an evaluation (> 0).
        stop_at: stop before the end of the budget, at the first fresh evaluation whose mean true
            return is at least this, if at least 99 % of its episodes succeed and all of those
            with mean actions. ``None``: train to the end.
        num_envs: worlds side by side; ``None`` for the setting's own number.
        hyperparams: a YAML file whose block of the setting takes the place of the recorded one.
        transferred_from: under setting C, the folder of the run whose policy it begins with.
        device: what the networks run on, ``"cpu"`` or ``"cuda"``.
        label: what tables and figures call it; ``None`` for :func:`default_label`.
        environment: settings of the environment that differ from the algorithm's own.
        hyperparameters: hyperparameters that differ from the algorithm's own.

    Raises:
        ConfigError: naming every number out of range, or a setting the algorithm does not have.
        MbnError: the algorithm or the field is not valid.
    """

    algorithm: str
    field: str
    setting: Setting = "N"
    seed: int = 0
    steps: int = 655_360
    evaluate_every: int = 32_768
    episodes: int = 100
    stop_at: float | None = None
    num_envs: int | None = None
    hyperparams: Path | None = None
    transferred_from: Path | None = None
    device: Literal["cpu", "cuda"] = "cpu"
    label: str | None = None
    environment: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    hyperparameters: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check the numbers and the names."""
        counts = {"steps": 1, "evaluate_every": 1, "episodes": 1, "num_envs": 1}
        problems = [
            f"{name}: must be at least {least} (got {value})"
            for name, least in {"seed": 0, **counts}.items()
            if (value := getattr(self, name)) is not None and value < least
        ]
        if self.seed > MOST_SEED:
            problems.append(f"seed: must be at most 2^32 - 1 (got {self.seed})")
        if problems:
            raise ConfigError("training", problems)
        algorithm = find_algorithm(self.algorithm)
        if self.setting not in algorithm.settings:
            allowed = ", ".join(algorithm.settings)
            problems.append(f"setting: {self.algorithm} has {allowed}, not {self.setting}")
        elif self.setting == "C" and self.transferred_from is None:
            problems.append("setting: C goes on from a trained policy; name its run with --from")
        elif self.setting != "C" and self.transferred_from is not None:
            problems.append(f"from: setting {self.setting} begins anew; allowed: setting C")
        if self.label is not None and not LABEL.fullmatch(self.label):
            problems.append(
                f"label: {self.label!r}; allowed: letters, digits, _ . + -, the first a letter "
                "or digit"
            )
        if problems:
            raise ConfigError("training", problems)
        load_field(self.field)

    @property
    def name(self) -> str:
        """The run's name, unique in a comparison: label or algorithm and setting; field; seed."""
        form = find_algorithm(self.algorithm).form
        learner = f"{self.algorithm}-{self.setting}" if form == "centralized" else self.algorithm
        return f"{self.label or learner}-{Path(self.field).stem}-seed{self.seed}"

    @property
    def shown_as(self) -> str:
        """What tables and figures call it."""
        return self.label or default_label(self.algorithm, self.setting)

    @property
    def command(self) -> str:
        """The command line that repeats this run."""
        options = {
            "--setting": self.setting,
            "--seed": self.seed,
            "--steps": self.steps,
            "--evaluate-every": self.evaluate_every,
            "--episodes": self.episodes,
            "--stop-at": self.stop_at,
            "--num-envs": self.num_envs,
            "--hyperparams": self.hyperparams,
            "--from": self.transferred_from,
            "--device": self.device,
            "--label": self.label,
        }
        given = {name: value for name, value in options.items() if value is not None}
        words = [str(word) for option in given.items() for word in option]
        environment = {ENVIRONMENT: self.environment} if self.environment else {}
        if changes := words_of({**self.hyperparameters, **environment}):
            words += ["--set", *changes]
        return shlex.join(["mbn", "train", self.algorithm, self.field, *words])


def default_label(algorithm: str, setting: str) -> str:
    """What tables and figures call a run without a label: setting N goes without saying."""
    return algorithm if setting == "N" else f"{algorithm}-{setting}"


class Budget(NamedTuple):
    """The env-steps of a run, rounded up.

    Attributes:
        env_steps: how many it takes, unless it stops early.
        unit: what the algorithm learns from, in words.
        exact: if not, ``env_steps`` is the most that it may take.
    """

    env_steps: int
    unit: str
    exact: bool = True


@dataclass(frozen=True)
class Task:
    """What a trainer gets: the request with its field loaded and its settings resolved.

    Attributes:
        config: the request.
        field: the field to train on.
        settings: keyword arguments of the environment: the algorithm's own and the request's.
    """

    config: TrainConfig
    field: Field
    settings: Mapping[str, Any]
