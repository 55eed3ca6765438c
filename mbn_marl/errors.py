"""The errors of the suite. Each names the place of the problem and what is allowed there."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


class MbnError(ValueError):
    """Base of every error that bad input can cause."""


def unknown(kind: str, name: str, known: Iterable[str]) -> str:
    """Return what is wrong with a name that is none of ``known``: what may be meant, and all.

    Args:
        kind: of the name, such as ``"field"``.
        name: as it was given.
        known: the names that there are.
    """
    names = list(known)
    close = get_close_matches(name[:100], names, n=3, cutoff=0.7)
    hint = f" (did you mean {' or '.join(close)}?)" if close else ""
    return f"unknown {kind}{hint}; known: {', '.join(names) or 'none'}"


class ProblemsError(MbnError):
    """An error that lists every problem found, one line each, with its place.

    Attributes:
        source: what was being read (a file, ``"field"``, ``"configuration"``).
        problems: one line per problem, ``"place: what is wrong and what is allowed"``.
    """

    def __init__(self, source: str, problems: Iterable[str]) -> None:
        self.source = source
        self.problems = list(problems)
        count = len(self.problems)
        title = f"{source}: {count} problem{'s' if count != 1 else ''}"
        super().__init__("\n  - ".join([title, *self.problems]))


class FieldError(ProblemsError):
    """A field, or a file that should hold one, is not valid."""


class ConfigError(ProblemsError):
    """A setting of the environment is not valid."""


class EpisodeError(ProblemsError):
    """An episode, or a file that should hold one, is not valid or does not replay."""


class DamageError(MbnError):
    """A file is not what was written there: it was changed, cut off or damaged since."""


class DisplayError(MbnError, RuntimeError):
    """There is no display to open a window on."""


class SimulatorError(MbnError, RuntimeError):
    """A simulator cannot be reached, stopped answering, or refused what it was asked."""


class ActionError(MbnError):
    """An action is missing, of the wrong shape, not finite, or for an unknown agent.

    It is raised before anything moves: the environment is left as it was.
    """


class StepError(MbnError):
    """The environment was stepped before a reset or after the end of the episode."""
