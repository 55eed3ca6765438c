"""Who acts where: the field, the settings and the policy that a command line names."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from baselines.evaluation.fitting import LoadedPolicy
from baselines.evaluation.policy import Policy
from baselines.zoo.entries import PREFIX, entry_names
from baselines.zoo.sources import RANDOM, find_policy, goes_anywhere, is_trained
from mbn_marl.episode import is_episode_file
from mbn_marl.errors import ConfigError
from mbn_marl.field import Field, load_field


@dataclass(frozen=True)
class Actor:
    """A policy in its field, with the environment's settings and a name in words."""

    policy: Policy
    field: Field
    settings: Mapping[str, Any]
    name: str


def find_actor(source: str, policy: str | None = None, **how: Any) -> Actor:
    """Find the actor of a command line.

    Args:
        source: a run's folder or ``zoo:NAME``, with their field; or a field's name or file.
        policy: in a field: what :func:`baselines.load_policy` takes; ``None`` for random.
        **how: the seed of random actions, and settings that replace those of the policy.

    Raises:
        MbnError: one of them is not there.
        ConfigError: a policy for a run, which has its own, or one for other numbers of robots or
            ROIs than the field's.
    """
    if is_trained(source):
        if goes_anywhere(source):
            problem = f"{source} is for any field; name one, and {source} as its policy"
            raise ConfigError("policy", [problem])
        if policy is None:
            return _actor(find_policy(source, **how), source)
        problem = f"policy: {source} has its own; to try another, name a field"
        raise ConfigError("policy", [problem])
    if is_episode_file(source):
        raise ConfigError("policy", [f"{source} is an episode; `mbn replay` plays it"])
    field, name = load_field(source), policy or RANDOM
    acts = "random actions" if name == RANDOM else f"{name} in {field.name}"
    return _actor(find_policy(name, field, **how), acts)


def zoo_policy(source: str) -> str | None:
    """Return the zoo's policy for a field of the catalogue, if there is one."""
    return f"{PREFIX}{source}" if source in entry_names() else None


def _actor(loaded: LoadedPolicy, name: str) -> Actor:
    assert loaded.field is not None  # a run has one, and others are given one
    return Actor(loaded.policy, loaded.field, loaded.settings, name)
