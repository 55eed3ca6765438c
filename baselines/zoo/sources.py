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
from mbn_marl.field import Field, load_field

RANDOM = "random"
ZOO = PREFIX.rstrip(":")
"""The zoo's own policy for each field."""


def brings_field(source: str) -> bool:
    """Return whether a source is a policy with a field: of the zoo, or a run's folder."""
    return source.startswith(PREFIX) or Path(source).is_dir()


def takes_field(source: str) -> bool:
    """Return whether a source is the name of policies for any field, or ``module:callable``."""
    own = is_own(source) and not brings_field(source)
    return source in (RANDOM, ZOO, *CLASSICAL) or own


def find_policy(
    source: str, field: str | Path | Field | None = None, *, seed: int = 0, **settings: Any
) -> LoadedPolicy:
    """Find a policy; see :func:`baselines.load_policy`."""
    place = None if field is None else load_field(field)
    condition = settings.pop("condition", None)
    if place is None and source in (ZOO, *CLASSICAL):
        raise ConfigError("policy", [f"field: {source} has none of its own; name one"])
    if source in CLASSICAL and place is not None:
        wanted = under({}, condition, **settings)
        return LoadedPolicy(source, make_classical(source, place, wanted), wanted, place)
    if source == RANDOM:
        wanted = under({}, condition, **settings)
        return LoadedPolicy(source, RandomPolicy(seed), wanted, place)
    if takes_field(source) and source != ZOO:
        own = load_own(source, place)
        return LoadedPolicy(source, own, under(own.settings, condition, **settings), place)
    if not (source == ZOO or brings_field(source)):
        known = (*CLASSICAL, RANDOM, ZOO, f"{PREFIX}NAME", FORM)
        raise RunError(f"{source} is not a run folder: {unknown('policy', source, known)}")
    run = open_run(source if place is None or source != ZOO else f"{PREFIX}{place.name}")
    wanted = under(run.config["environment"], condition, **settings)
    if place is None and isinstance(run.fields, Field):
        place = run.fields
    return LoadedPolicy(source, load_trained(run), wanted, place)
