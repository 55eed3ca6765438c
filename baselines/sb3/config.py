"""The hyperparameters of Stable-Baselines3's algorithms: ``hyperparams/<algorithm>.yaml``."""

import inspect
import json
import math
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from pkgutil import resolve_name
from typing import Annotated, Any

import pydantic

from baselines.training.aids import Count, TrainingAids
from baselines.training.config import merged, read_block, validate
from mbn_marl.config import describe
from mbn_marl.errors import ConfigError, unknown

FOLDER = Path(__file__).with_name("hyperparams")
CLASSES = {
    "a2c": "stable_baselines3:A2C",
    "ppo": "stable_baselines3:PPO",
    "trpo": "sb3_contrib:TRPO",
    "ars": "sb3_contrib:ARS",
    "ppo-shared": "stable_baselines3:PPO",
    "crossq": "sb3_contrib:CrossQ",
    "crossq-sbx": "baselines.sb3.sbx:CrossQ",
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
        ("roi_radius", "scattered", "episode_steps"), ("a2c", "ppo", "trpo", "ppo-shared")
    ),
    "joint_observation": ("a2c", "ppo", "trpo", "ars", "crossq", "crossq-sbx", "tqc"),
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
    model: dict[str, Any] = pydantic.Field(default_factory=dict)


@dataclass(frozen=True)
class LinearSchedule:
    start: float
    end: float

    def __call__(self, progress_remaining: float) -> float:
        # From 1 at the start to 0 at the end. The last rollout may go past the budget, where the
        # library's number is negative.
        return self.end + (self.start - self.end) * max(progress_remaining, 0.0)


def algorithm_class(algorithm: str) -> Any:
    return resolve_name(CLASSES[algorithm])


def load(
    algorithm: str,
    setting: str,
    overrides: Mapping[str, Any],
    *,
    num_envs: int | None = None,
    file: Path | None = None,
) -> SB3Config:
    # Setting C fine-tunes with the values of A. An override of ``model`` changes the arguments it
    # names and leaves the others.
    name = "A" if setting == "C" and file is None else setting
    place = f"hyperparameters of {algorithm}" if file is None else str(file)
    block = read_block(file or FOLDER / f"{algorithm}.yaml", name)
    values = {**block, **overrides, **({} if num_envs is None else {"num_envs": num_envs})}
    if "model" in block and "model" in overrides:
        values["model"] = merged(block["model"], overrides["model"])
    fields, accepted = SB3Config.model_fields, accepted_arguments(algorithm)
    offered = {name: algorithm in OFFERED.get(name, CLASSES) for name in fields}
    known = [name for name, field in fields.items() if offered[name] and field.repr]
    known += [f"model.{name}" for name in accepted]
    problems = [f"{name}: {unknown('name', name, known)}" for name in values if name not in fields]
    config = SB3Config(source="")
    try:
        config = validate(SB3Config, {n: v for n, v in values.items() if n in fields}, place)
    except ConfigError as error:
        problems += error.problems
    foreign = {n: v for n, v in config.model.items() if n in TUNED_IN_PAPER and n not in accepted}
    model = {n: v for n, v in config.model.items() if n not in foreign}
    problems += [
        f"{name}: allowed for {', '.join(OFFERED[name])}, not for {algorithm}"
        for name in config.model_dump(exclude_defaults=True)
        if not offered[name]
    ]
    kinds: Any = {
        name: (Annotated[kind, pydantic.AfterValidator(partial(_in_range, name))], None)
        for name, kind in accepted.items()
    }
    strict = pydantic.ConfigDict(strict=True, extra="forbid", arbitrary_types_allowed=True)
    arguments = pydantic.create_model("model", __config__=strict, **kinds)
    try:
        arguments.model_validate({name: _scheduled(value) for name, value in model.items()})
    except pydantic.ValidationError as error:
        problems += [f"model.{problem}" for problem in describe(error, arguments)]
    if problems:
        raise ConfigError(place, problems)
    return config.model_copy(update={"model": model, "skipped": {**config.skipped, **foreign}})


def accepted_arguments(algorithm: str) -> dict[str, Any]:
    parameters = inspect.signature(algorithm_class(algorithm)).parameters
    return {name: one.annotation for name, one in parameters.items() if name not in RESERVED}


def model_arguments(config: SB3Config) -> dict[str, Any]:
    own = deepcopy(config.model)  # the library writes into policy_kwargs
    return {name: _scheduled(value) for name, value in own.items()}


def _scheduled(value: Any) -> Any:
    match value:
        case {"from": int() | float() as start, "to": int() | float() as end} if len(value) == 2:
            return LinearSchedule(start, end)
    return value


def _in_range(name: str, value: Any) -> Any:
    if isinstance(value, dict | list):
        json.dumps(value, allow_nan=False, default=str)  # numbers in them have to be finite
    ends = (value.start, value.end) if isinstance(value, LinearSchedule) else (value,)
    least, most = RANGES.get(name, (-math.inf, math.inf))
    for number in (end for end in ends if isinstance(end, int | float)):
        if not (math.isfinite(number) and least <= number <= most):
            raise ValueError(f"must be finite, at least {least:g}, at most {most:g}")
    return value
