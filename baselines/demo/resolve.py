"""Who acts where: the field, the settings and the policy that a command line names."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from baselines.classical.controller import CLASSICAL
from baselines.evaluation.policy import Policy
from baselines.zoo.entries import PREFIX, entry_names
from baselines.zoo.sources import RANDOM, find_policy, is_policy, needs_field
from mbn_marl.episode import is_episode_file
from mbn_marl.errors import ConfigError, FieldError, unknown
from mbn_marl.field import Field, catalogue_names, load_field


@dataclass(frozen=True)
class Actor:
    """A policy in its field, with the environment's settings and a name in words."""

    policy: Policy
    field: Field
    settings: Mapping[str, Any]
    name: str


def find_actor(
    source: str, field: str | None = None, *, alone: Callable[[str], str] | None = None, **how: Any
) -> Actor:
    """Find who acts where, as the command line of every command says it.

    Args:
        source: what :func:`baselines.load_policy` takes; or a field's name or file, if there is
            ``alone``.
        field: a field's name or file; ``None`` for the policy's.
        alone: the policy in a field that is named without one.
        **how: the seed of random actions, and settings that replace those of the policy.

    Raises:
        MbnError: one of them is not there.
        ConfigError: the policy has no field, or it is for other robots or ROIs than the field's.
    """
    if is_episode_file(source):
        raise ConfigError("policy", [f"{source} is an episode; `mbn replay` plays it"])
    if alone is not None and field is None and not is_policy(source):
        if not Path(source).suffix and source not in (known := catalogue_names()):
            problem = unknown("policy or field", source, (*CLASSICAL, RANDOM, *known))
            raise FieldError("field", [f"{source}: {problem}"])
        load_field(source)
        field, source = source, alone(source)
    loaded = find_policy(source, field, **how)
    if loaded.field is None:
        raise needs_field(source)
    name = source if field is None else f"{source} in {loaded.field.name}"
    return Actor(loaded.policy, loaded.field, loaded.settings, name)


def zoo_policy(source: str) -> str:
    """Return the zoo's policy for a field of the catalogue if there is one, else random."""
    return f"{PREFIX}{source}" if source in entry_names() else RANDOM
