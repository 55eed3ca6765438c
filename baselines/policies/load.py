"""From a name to a policy: load it, merge the settings once, fit it to the field once."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from baselines.policies.classical import CLASSICAL, make_classical
from baselines.policies.loaded import LoadedPolicy, needs_field
from baselines.policies.own import FORM, OwnPolicy, import_own, is_own
from baselines.policies.policy import Policy, RandomPolicy
from baselines.policies.trained import PREFIX, entry_names, is_trained, load_trained, open_run
from baselines.runs.files import RunError
from mbn_marl.config import CONDITIONS, Condition, expand
from mbn_marl.episode import is_episode_file
from mbn_marl.errors import ConfigError, FieldError, unknown
from mbn_marl.field import Field, catalogue_names, load_field

RANDOM = "random"
ZOO = "zoo"
"""The zoo's policy of each field."""


def is_policy(source: str) -> bool:
    """Return whether a source reads as that of a policy; else it is a field, or unknown."""
    return source in (RANDOM, ZOO, *CLASSICAL) or is_own(source) or is_trained(source)


def check_known(source: str) -> None:
    """Check that a source is that of a policy.

    Raises:
        RunError: it is none; listing those that there are.
        MbnError: the zoo has no such policy.
    """
    if not is_policy(source):
        others = f"{PREFIX}NAME", FORM, "the folder of a run"
        problem = unknown("policy", source, (*CLASSICAL, RANDOM, ZOO, *others))
        if source in catalogue_names():
            problem = f"is a field; name a policy, for example: greedy --field {source}"
        raise RunError(f"{source}: {problem}")
    if source.startswith(PREFIX):
        open_run(source)


class Source:
    """A policy by name, with what is the same in all fields loaded: weights, or your module.

    Args:
        name: as for :func:`baselines.load_policy`.
    """

    def __init__(self, name: str) -> None:
        check_known(name)
        self.name = name
        self.run = open_run(name) if is_trained(name) else None
        self._trained = None if self.run is None else load_trained(self.run)
        self._own = import_own(name) if self.run is None and is_own(name) else None

    def make(
        self,
        field: str | Path | Field | None = None,
        *,
        seed: int = 0,
        condition: Condition | None = None,
        **asked: Any,
    ) -> LoadedPolicy:
        """Return the policy for a field, with its settings; see :func:`baselines.load_policy`."""
        place = None if field is None else load_field(field)
        name = self.name if place is None else f"{self.name} in {place.name}"
        if place is None and self.name in (ZOO, *CLASSICAL):
            raise needs_field(self.name)
        if self.name == ZOO and place is not None:
            one = Source(f"{PREFIX}{place.name}").make(place, condition=condition, **asked)
            return LoadedPolicy(name, one.policy, one.settings, place)
        policy: Policy = RandomPolicy(seed)
        brought: Mapping[str, Any] = {}
        if self._own is not None:
            policy = own = OwnPolicy(self.name, self._own, place)
            brought = own.settings
        elif self.run is not None and self._trained is not None:
            policy, brought = self._trained, self.run.config["environment"]
            if place is None and isinstance(home := self.run.fields, Field):
                place = home
        settings = merge_settings(brought, condition, **asked)
        if self.name in CLASSICAL and place is not None:
            policy = make_classical(self.name, place, settings)
        return LoadedPolicy(name, policy, settings, place)


def find_policy(
    source: str, field: str | None = None, *, alone: Callable[[str], str] | None = None, **how: Any
) -> LoadedPolicy:
    """Find the policy that a command line names, and its field.

    Args:
        source: as for :func:`baselines.load_policy`; or, with ``alone``, a field's name or file.
        field: a field's name or file; ``None`` for the policy's.
        alone: returns the policy of a field that is named without one.
        **how: the seed of random actions, and settings that replace those of the policy.

    Raises:
        MbnError: one of them is not there.
        ConfigError: the policy has no field.
    """
    if is_episode_file(source):
        raise ConfigError("policy", [f"{source} is an episode; `mbn replay` plays it"])
    if alone is not None and field is None and not is_policy(source):
        if not Path(source).suffix and source not in (known := catalogue_names()):
            problem = unknown("policy or field", source, (*CLASSICAL, RANDOM, *known))
            raise FieldError("field", [f"{source}: {problem}"])
        load_field(source)
        field, source = source, alone(source)
    found = Source(source).make(field, **how)
    if found.field is None:
        raise needs_field(source)
    return found


def of_zoo(field: str) -> str:
    """Return the zoo's policy for a field of the catalogue if there is one, else random."""
    return f"{PREFIX}{field}" if field in entry_names() else RANDOM


def merge_settings(
    settings: Mapping[str, Any], condition: Condition | None, **asked: Any
) -> dict[str, Any]:
    """Return the settings of a policy under a condition; ``None`` leaves them as they are.

    Weather, disturbances and failures are those of the condition alone; ``asked`` are settings
    that replace others too.

    Raises:
        ConfigError: the condition sets what is asked for.
    """
    if condition is None:
        return {**settings, **asked}
    weather = {name for one in CONDITIONS if one != "mixed" for name in CONDITIONS[one]}
    others = {name: value for name, value in expand(settings).items() if name not in weather}
    return {**others, **expand({**asked, "condition": condition})}
