"""The hyperparameters of Stable-Baselines3's algorithms: ``hyperparams/<algorithm>.yaml``."""

from __future__ import annotations

import inspect
import json
import math
from collections.abc import Iterator, Mapping
from copy import deepcopy
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from baselines.training.aids import Count, TrainingAids
from baselines.training.config import read_block, validate
from mbn_marl.errors import ConfigError, unknown

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

FOLDER = Path(__file__).with_name("hyperparams")
CLASSES = {
    "a2c": "stable_baselines3:A2C",
    "ppo": "stable_baselines3:PPO",
    "trpo": "sb3_contrib:TRPO",
    "ars": "sb3_contrib:ARS",
    "ppo-shared": "stable_baselines3:PPO",
    "crossq": "sb3_contrib:CrossQ",
    "tqc": "sb3_contrib:TQC",
}
# The learner sets some arguments; others are objects and classes, which no file can hold. Noise
# that depends on the state is drawn in ways that evaluations and resuming cannot repeat.
RESERVED = (
    *("policy", "env", "seed", "device", "verbose", "tensorboard_log", "_init_setup_model"),
    *("action_noise", "rollout_buffer_class", "replay_buffer_class"),
    *("use_sde", "sde_sample_freq"),
)
_COUNT, _SHARE, _AMOUNT = (1, math.inf), (0, 1), (0, math.inf)
# The ranges of the numbers of ``model``, which the library does not check.
RANGES: Mapping[str, tuple[float, float]] = {
    **dict.fromkeys(("n_steps", "batch_size", "n_epochs", "buffer_size", "train_freq"), _COUNT),
    **dict.fromkeys(("policy_delay", "target_update_interval", "stats_window_size"), _COUNT),
    **dict.fromkeys(("n_critic_updates", "cg_max_steps", "line_search_max_iter"), _COUNT),
    **dict.fromkeys(("sub_sampling_factor", "n_delta", "n_top", "n_eval_episodes"), _COUNT),
    **dict.fromkeys(("gamma", "gae_lambda", "tau", "line_search_shrinking_factor"), _SHARE),
    **dict.fromkeys(("learning_rate", "delta_std", "clip_range", "clip_range_vf"), _AMOUNT),
    **dict.fromkeys(("ent_coef", "vf_coef", "max_grad_norm", "rms_prop_eps"), _AMOUNT),
    **dict.fromkeys(("target_kl", "cg_damping", "learning_starts"), _AMOUNT),
    "top_quantiles_to_drop_per_net": _AMOUNT,
    "gradient_steps": (-1, math.inf),
}
# The paper tuned these, some for algorithms without such an argument: a run skips those and says
# so. Any other name that the library's class does not take is an error.
TUNED_IN_PAPER = (
    *("learning_rate", "gamma", "gae_lambda", "vf_coef", "ent_coef", "max_grad_norm"),
    "buffer_size",
)
# The algorithms that offer a hyperparameter, where not all do.
OFFERED: Mapping[str, tuple[str, ...]] = {
    **dict.fromkeys(
        ("action_repeat", "roi_radius", "scattered", "episode_steps"),
        ("a2c", "ppo", "trpo", "ppo-shared"),
    ),
    "joint_observation": ("a2c", "ppo", "trpo", "ars", "crossq", "tqc"),
}


class SB3Config(TrainingAids):
    """A setting of one algorithm. The defaults are setting A: the library's, on raw numbers."""

    # Worlds stepped side by side.
    num_envs: Count = 1
    # The learner sees what it observes normalised by its running mean and variance, or raw.
    normalize_observation: bool = False
    # A centralised learner observes what all robots do, side by side, or the paper's state.
    joint_observation: bool = False
    # The library's name of the policy.
    policy: str = "MlpPolicy"
    # Arguments of the library's class; {from: a, to: b} for a number falls linearly over training.
    model: dict[str, Any] = Field(default_factory=dict)


class LinearSchedule(BaseModel):
    """A number that changes linearly over training, as Stable-Baselines3 calls it."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    start: float = Field(alias="from")
    end: float = Field(alias="to")

    def __call__(self, progress_remaining: float) -> float:
        # From 1 at the start to 0 at the end. The last rollout may go past the budget, where the
        # library's number is negative.
        return self.end + (self.start - self.end) * max(progress_remaining, 0.0)


def algorithm_class(algorithm: str) -> type[BaseAlgorithm]:
    found: type[BaseAlgorithm] = resolve_name(CLASSES[algorithm])
    return found


def load(
    algorithm: str,
    setting: str,
    overrides: Mapping[str, Any],
    *,
    num_envs: int | None = None,
    file: Path | None = None,
) -> SB3Config:
    """The hyperparameters of an algorithm, as :meth:`baselines.algorithms.Algorithm.resolve`.

    Setting C fine-tunes with the values of A. An override of ``model`` changes the arguments it
    names and leaves the others.
    """
    name = "A" if setting == "C" and file is None else setting
    place = f"hyperparameters of {algorithm}" if file is None else str(file)
    block = read_block(file or FOLDER / f"{algorithm}.yaml", name)
    values = {**block, **overrides, **({} if num_envs is None else {"num_envs": num_envs})}
    if isinstance(block.get("model"), dict) and isinstance(overrides.get("model"), dict):
        values["model"] = {**block["model"], **overrides["model"]}
    config, accepted = validate(SB3Config, values, place), accepted_arguments(algorithm)
    foreign = {name: value for name, value in config.model.items() if name not in accepted}
    problems = [
        f"model.{name}: {unknown('name', name, sorted(accepted))}"
        for name in sorted(set(foreign) - set(TUNED_IN_PAPER))
    ]
    problems += [
        f"{name}: allowed for {', '.join(OFFERED[name])}, not for {algorithm}"
        for name in config.model_dump(include=set(OFFERED), exclude_defaults=True)
        if algorithm not in OFFERED[name]
    ]
    problems += [
        f"model.{name}: {problem} (got {value!r:.80})"
        for name, value in config.model.items()
        for problem in _problems(name, value, accepted.get(name, Any))
    ]
    if problems:
        raise ConfigError(place, problems)
    kept = {name: value for name, value in config.model.items() if name in accepted}
    return config.model_copy(update={"model": kept, "skipped": {**config.skipped, **foreign}})


def accepted_arguments(algorithm: str) -> dict[str, Any]:
    """The names that ``model`` may have, with their types in the library's class."""
    parameters = inspect.signature(algorithm_class(algorithm)).parameters
    return {name: one.annotation for name, one in parameters.items() if name not in RESERVED}


def model_arguments(config: SB3Config) -> dict[str, Any]:
    """The arguments of the library's class, with schedules as functions."""
    own = deepcopy(config.model)  # the library writes into policy_kwargs
    return {name: _scheduled(value) for name, value in own.items()}


def _scheduled(value: Any) -> Any:
    is_schedule = isinstance(value, dict) and set(value) == {"from", "to"}
    return LinearSchedule(**value) if is_schedule else value


def _problems(name: str, value: Any, its_type: Any) -> Iterator[str]:
    """Yield the problems of an argument of the library's class that has the type ``its_type``."""
    strict = ConfigDict(strict=True, arbitrary_types_allowed=True)
    try:
        if isinstance(value, dict | list):
            json.dumps(value, allow_nan=False, default=str)
        scheduled = TypeAdapter(its_type, config=strict).validate_python(_scheduled(value))
    except ValidationError as error:
        allowed = " or ".join(dict.fromkeys(problem["msg"] for problem in error.errors()))
        yield allowed.replace("Input should be callable", "{from: number, to: number}")
        return
    except ValueError:
        yield "must hold finite numbers only"
        return
    ends = value.values() if isinstance(scheduled, LinearSchedule) else (value,)
    least, most = RANGES.get(name, (-math.inf, math.inf))
    for number in (end for end in ends if isinstance(end, int | float)):
        if not (math.isfinite(number) and least <= number <= most):
            upper = "" if math.isinf(most) else f" and at most {most}"
            yield f"must be a finite number, at least {least:g}{upper}"
