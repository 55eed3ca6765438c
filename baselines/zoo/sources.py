"""Where policies come from: the zoo, runs, those without learning, users' own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from baselines.classical.controller import CLASSICAL, make_classical
from baselines.evaluation.evaluate import under
from baselines.evaluation.fitting import LoadedPolicy
from baselines.evaluation.policy import RandomPolicy, load_trained
from baselines.runs.files import RunError
from baselines.zoo.entries import PREFIX, open_run
from baselines.zoo.own import FORM, is_own, load_own
from mbn_marl.errors import ConfigError, unknown
from mbn_marl.field import Field, catalogue_names, load_field

RANDOM = "random"
ZOO = PREFIX.rstrip(":")
"""The zoo's own policy for each field."""


def is_trained(source: str) -> bool:
    """Return whether a source is one trained policy: of the zoo, or a run's folder."""
    return source.startswith(PREFIX) or Path(source).is_dir()


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


def find_policy(
    source: str, field: str | Path | Field | None = None, *, seed: int = 0, **settings: Any
) -> LoadedPolicy:
    """Find a policy; see :func:`baselines.load_policy`."""
    check_known(source)
    place = None if field is None else load_field(field)
    condition = settings.pop("condition", None)
    if place is None and source in (ZOO, *CLASSICAL):
        raise needs_field(source)
    if source in CLASSICAL and place is not None:
        wanted = under({}, condition, **settings)
        return LoadedPolicy(source, make_classical(source, place, wanted), wanted, place)
    if source == RANDOM:
        wanted = under({}, condition, **settings)
        return LoadedPolicy(source, RandomPolicy(seed), wanted, place)
    if is_own(source) and not is_trained(source):
        own = load_own(source, place)
        return LoadedPolicy(source, own, under(own.settings, condition, **settings), place)
    run = open_run(source if place is None or source != ZOO else f"{PREFIX}{place.name}")
    wanted = under(run.config["environment"], condition, **settings)
    if place is None and isinstance(home := run.fields, Field):
        place = home
    return LoadedPolicy(source, load_trained(run), wanted, place)


def needs_field(source: str) -> ConfigError:
    """Return the error of a policy that has no field."""
    return ConfigError("policy", [f"field: {source} has none; name one, such as --field field_03"])
