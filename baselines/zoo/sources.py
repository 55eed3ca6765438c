"""Where policies come from: the zoo, runs, those without learning, users' own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from baselines.classical.controller import CLASSICAL, make_classical
from baselines.evaluation.evaluate import under
from baselines.evaluation.fitting import LoadedPolicy
from baselines.evaluation.lookahead import Lookahead
from baselines.evaluation.policy import RandomPolicy, load_trained
from baselines.runs.files import RunError
from baselines.zoo.entries import PREFIX, open_run
from baselines.zoo.own import FORM, is_own, load_own
from mbn_marl.errors import ConfigError, unknown
from mbn_marl.field import Field, FieldSampler, load_field

RANDOM = "random"
LOOKAHEAD = "lookahead:"
"""Before a source: the policy looks ahead."""
ZOO = PREFIX.rstrip(":")
"""The zoo's own policy for each field."""


def is_trained(source: str) -> bool:
    """Return whether a source is one trained policy: of the zoo, or a run's folder."""
    return source.startswith(PREFIX) or Path(source).is_dir()


def goes_anywhere(source: str) -> bool:
    """Return whether a source is a policy that was trained on random fields.

    Raises:
        MbnError: there is no such entry of the zoo, or the folder is that of no run.
    """
    return is_trained(source) and isinstance(open_run(source).fields, FieldSampler)


def takes_field(source: str) -> bool:
    """Return whether a source is for any field, or ``module:callable``.

    Raises:
        MbnError: as :func:`goes_anywhere`.
    """
    given = source in (RANDOM, ZOO, *CLASSICAL) or source.startswith(LOOKAHEAD)
    return given or _is_own(source) or goes_anywhere(source)


def _is_own(source: str) -> bool:
    return is_own(source) and not is_trained(source)


def find_policy(
    source: str, field: str | Path | Field | None = None, *, seed: int = 0, **settings: Any
) -> LoadedPolicy:
    """Find a policy; see :func:`baselines.load_policy`."""
    if source.startswith(LOOKAHEAD):
        if (base := source.removeprefix(LOOKAHEAD)) in ("", RANDOM):
            raise ConfigError(
                "policy", [f"{source!r}; allowed after {LOOKAHEAD} a policy, but random"]
            )
        found = find_policy(base, field, seed=seed, **settings)
        if found.field is None:
            raise ConfigError("policy", [f"field: {source} looks ahead in one; name it"])
        return LoadedPolicy(source, Lookahead(found), found.settings, found.field)
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
    if _is_own(source):
        own = load_own(source, place)
        return LoadedPolicy(source, own, under(own.settings, condition, **settings), place)
    if not (source == ZOO or is_trained(source)):
        known = (*CLASSICAL, RANDOM, ZOO, f"{PREFIX}NAME", f"{LOOKAHEAD}POLICY", FORM)
        raise RunError(f"{source} is not a run folder: {unknown('policy', source, known)}")
    run = open_run(source if place is None or source != ZOO else f"{PREFIX}{place.name}")
    wanted = under(run.config["environment"], condition, **settings)
    if place is None and isinstance(home := run.fields, Field):
        place = home
    return LoadedPolicy(source, load_trained(run), wanted, place)
