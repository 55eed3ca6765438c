"""Policies that users write, named ``module:callable``."""

import inspect
import re
import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, get_args

import numpy as np

from baselines.policies.policy import Observes, Policy
from mbn_marl.config import make_config
from mbn_marl.errors import ConfigError, collecting
from mbn_marl.field import Field

FORM = "module:callable"


def is_own(source: str) -> bool:
    return re.fullmatch(r"\w+(\.\w+)*:\w+(\.\w+)*", source) is not None


class OwnPolicy(Policy):
    """The policy that a user's callable made for a field; its actions are checked."""

    def __init__(self, source: str, make: Callable[[Field | None], Any], field: Field | None):
        if not _takes(make, field):
            problem = f"callable: {source.partition(':')[2]}{inspect.signature(make)}"
            raise ConfigError(source, [f"{problem}; needed: one argument, the field"])
        self._given = source, make, field
        try:
            self._source, self._made = source, make(field)
        except (AttributeError, TypeError) as error:
            if field is None:
                error.add_note(f"{source} got no field; name one, such as --field field_03")
            raise
        made, act = self._made, getattr(self._made, "act", None)
        self.observes = getattr(made, "observes", "observations")
        self.settings: Mapping[str, Any] = getattr(made, "settings", {})
        self._act = act or (lambda seen, deterministic: made(seen))
        asked, needed = (act, "(observations, deterministic)") if act else (made, "(observations)")
        problems: list[str] = []
        if not callable(asked):
            what = "an object with act(observations, deterministic=True), or a function"
            problems.append(f"returned {type(made).__name__}; allowed: {what}")
        elif not _takes(asked, np.zeros(0), **({"deterministic": True} if act else {})):
            problems.append(f"{'act' if act else ''}{inspect.signature(asked)}; needed: {needed}")
        if self.observes not in get_args(Observes):
            allowed = " or ".join(map(repr, get_args(Observes)))
            problems.append(f"observes: {self.observes!r}; allowed: {allowed}")
        if isinstance(self.settings, Mapping):
            with collecting(problems):
                make_config(self.settings)
        else:
            problems.append(f"settings: {type(self.settings).__name__}; allowed: a dictionary")
        if problems:
            raise ConfigError(source, problems)

    def act(self, seen: np.ndarray, *, deterministic: bool) -> np.ndarray:
        try:
            actions = np.asarray(self._act(seen, deterministic=deterministic), np.float32)
        except (TypeError, ValueError, RuntimeError) as error:
            error.add_note(f"in {self._source}, for {self.observes} {seen.shape}")
            raise
        n = seen.shape[1] if self.observes == "observations" else "n"
        fits = actions.ndim == 3 and actions.shape[::2] == (len(seen), 2)
        if not fits or n not in ("n", actions.shape[1]):
            problem = f"actions: expected ({len(seen)}, {n}, 2), got {actions.shape}"
            raise ConfigError(self._source, [problem])
        return actions

    def of_robot(self, robot: int, robots: int) -> "OwnPolicy":
        return OwnPolicy(*self._given)  # a copy of a function would share what it remembers

    def reset(self, worlds: np.ndarray | None = None) -> None:
        getattr(self._made, "reset", lambda worlds: None)(worlds)


def import_own(source: str) -> Callable[[Field | None], Any]:
    """Return a user's callable; its module may lie in the working directory."""
    module, _, name = source.partition(":")
    path = [*sys.path]
    sys.path.append(str(Path.cwd()))
    try:
        make: Any = import_module(module)
        for part in name.split("."):
            make = getattr(make, part)
    except ModuleNotFoundError as error:
        if not f"{module}.".startswith(f"{error.name}."):
            raise  # of an import in the module
        raise ConfigError(source, [f"module: no module named {error.name!r}"]) from None
    except AttributeError as error:
        if error.name not in name.split("."):
            raise
        raise ConfigError(source, [f"callable: {error}"]) from None
    finally:
        sys.path[:] = path
    if not callable(make):
        problem = f"callable: {name} is {type(make).__name__}; allowed: a function or a class"
        raise ConfigError(source, [problem])
    found: Callable[[Field | None], Any] = make
    return found


def _takes(function: Callable[..., Any], *arguments: Any, **named: Any) -> bool:
    """Return whether a function can be called like this, as far as it says."""
    try:
        inspect.signature(function).bind(*arguments, **named)
    except (TypeError, ValueError) as error:
        return isinstance(error, ValueError)  # it has no signature
    return True
