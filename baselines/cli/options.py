"""The options of commands: dataclasses that tyro reads from the command line."""

import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro
from tyro.conf import Positional, arg

from mbn_marl.config import Condition
from mbn_marl.errors import ConfigError

Command = TypeVar("Command")
CORES = os.cpu_count() or 1
Output = Annotated[Path, arg(aliases=["-o"])]
OptionalOutput = Annotated[Path | None, arg(aliases=["-o"])]


def check_options(command: str, wrong: Mapping[str, object], problems: Sequence[str] = ()) -> None:
    """Raise a ConfigError with the keys of ``wrong`` whose value is true, and with ``problems``."""
    if found := [*(problem for problem, so in wrong.items() if so), *problems]:
        raise ConfigError(command, found)


def read_options(command: type[Command], words: Sequence[str], prog: str) -> Command:
    """Make a command of words; wrong options give SystemExit, wrong values an MbnError."""
    config = (tyro.conf.FlagCreatePairsOff,)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a default None that the class itself replaces
        return tyro.cli(command, prog=prog, args=words, config=config)


@dataclass(frozen=True, kw_only=True)
class Writes:
    force: bool = False
    """If an output exists, move it aside (to OUT.1, OUT.2, ...)."""


@dataclass(frozen=True, kw_only=True)
class InWeather(Writes):
    source: Positional[Annotated[str, arg(metavar="POLICY")]]
    """The folder of a run; zoo:NAME, a policy of `mbn zoo`; zoo, that of the field; greedy,
    planner, replan, open-loop, greedy-local, blind or random, see docs/planner.md; or
    module:callable, your own."""
    condition: Condition | None = None
    """A named condition, whose weather and failures replace those it was trained in."""
    wind: tuple[float, float] | None = None
    """Speed (units/step per step) and angle (degrees from +x) that replace the trained wind."""

    @property
    def asked(self) -> dict[str, Any]:
        return {"condition": self.condition} | ({} if self.wind is None else {"wind": self.wind})

    @property
    def weather(self) -> str:
        wind = "" if self.wind is None else ", wind {:g} at {:g} degrees".format(*self.wind)
        return ("" if self.condition is None else f", {self.condition}") + wind


@dataclass(frozen=True, kw_only=True)
class Subject(InWeather):
    field: str | None = None
    """A name of `mbn fields`, or a field file; by default that of the run or of zoo:NAME."""
