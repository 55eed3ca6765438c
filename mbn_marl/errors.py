"""The errors of the suite. Each names the place of the problem and what is allowed there."""

from __future__ import annotations

from collections.abc import Iterable


class MbnError(ValueError):
    """Base of every error that bad input can cause."""


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
