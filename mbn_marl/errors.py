"""The errors of the suite. Each names the place of the problem and what is allowed there."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from importlib import import_module
from typing import Any


class MbnError(ValueError):
    """Base of all errors for bad input."""


def check_text(words: str) -> None:
    """Refuse what is not UTF-8, as Python holds it: in lone surrogates."""
    try:
        words.encode()
    except UnicodeEncodeError:
        raise MbnError(f"{words!a}: is not UTF-8; allowed: names in UTF-8") from None


def unknown(kind: str, name: str, known: Iterable[str]) -> str:
    """Return a message about a name that is none of ``known``: similar names, and all."""
    names = list(known)
    ends = {one.rpartition(".")[2]: one for one in reversed(names)}  # gamma means model.gamma
    close = get_close_matches(name[:100], [*dict.fromkeys([*ends, *names])], n=3, cutoff=0.7)
    close = close or [one for one in names if name and one.startswith(name)]
    meant = dict.fromkeys([ends.get(one, one) for one in close])
    hint = f" (did you mean {' or '.join(meant)}?)" if meant else ""
    return f"unknown {kind}{hint}; known: {', '.join(names) or 'none'}"


def install(extra: str) -> str:
    """Return the command that installs an extra of ``pyproject.toml``, such as ``"render"``."""
    return f"pip install '.[{extra}]' in a clone of mbn_marl"


def load(module: str, extra: str) -> Any:
    """Import a ``module``; the ImportError without it names the ``extra`` that brings it."""
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        name = module.partition(".")[0]
        raise ImportError(f"this needs {name}: {install(extra)}", name=name) from error


class ProblemsError(MbnError):
    """An error that lists every problem found, one line each, with its place.

    Attributes:
        source: the input with the problems (a file, ``"field"``, ``"configuration"``).
        problems: one line per problem, ``"place: what is wrong and what is allowed"``.
    """

    def __init__(self, source: str, problems: Iterable[str]) -> None:
        self.source = source
        self.problems = list(problems)
        count = len(self.problems)
        title = f"{source}: {count} problem{'s' if count != 1 else ''}"
        super().__init__("\n  - ".join([title, *self.problems]))


@contextmanager
def collecting(problems: list[str]) -> Iterator[None]:
    """Add an error's problems to ``problems``, once each and with their place; raise nothing."""
    try:
        yield
    except ProblemsError as error:
        found = [f"{error.source}: {problem}" for problem in error.problems]
    except MbnError as error:
        found = [str(error)]
    else:
        return
    problems += [problem for problem in found if problem not in problems]


class FieldError(ProblemsError):
    """A field or its file is not valid."""

    def beside(self, settings: Iterable[str]) -> FieldError:
        """Return the error with the problems of the settings that were given with the field."""
        return FieldError(self.source, [*self.problems, *(f"settings: {one}" for one in settings)])


class ConfigError(ProblemsError):
    """A setting of the environment is not valid."""


class EpisodeError(ProblemsError):
    """An episode or its file is not valid, or does not replay."""


class DisplayError(MbnError, RuntimeError):
    """There is no display for a window."""


class SimulatorError(MbnError, RuntimeError):
    """A simulator cannot be reached, stopped answering, or refused a request."""


class ActionError(MbnError):
    """An action is missing, of the wrong shape, not finite, or for an unknown agent.

    Nothing has moved: the environment is unchanged.
    """


class StepError(MbnError):
    """The environment was stepped before a reset or after the end of the episode."""
