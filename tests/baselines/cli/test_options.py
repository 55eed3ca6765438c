"""Options are read from dataclasses; a wrong one is named, and ends with code 2."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import pytest
from tyro.conf import Positional, arg

from baselines.cli.main import COMMANDS, main
from baselines.cli.options import read_options, whole_number
from mbn_marl.errors import ConfigError


@dataclass(frozen=True)
class Budget:
    """How long a run is.

    Attributes:
        steps: how many.
    """

    steps: int = 5

    def __post_init__(self) -> None:
        if self.steps < 1:
            raise ConfigError("budget", [f"steps: at least 1, not {self.steps}"])


@dataclass(frozen=True)
class Options:
    """Do something."""

    name: Positional[Annotated[str, arg(metavar="NAME")]]
    budget: Annotated[Budget, arg(name="")] = Budget()
    kind: Literal["short", "long"] = "short"
    wind: tuple[float, float] = (0.0, 0.5)
    seeds: tuple[int, ...] = ()
    limit: int | None = None
    """At most."""
    quiet: bool = False


def read(*words: str) -> Options:
    return read_options(Options, words, "mbn do")


def test_options_of_a_configuration_are_those_of_its_command() -> None:
    words = ("x", "--steps", "1e6", "--kind", "long", "--seeds", "1", "2_000", "--limit", "3e2")
    found = read(*words, "--wind", "-1e1", "2", "--quiet")
    assert found == Options("x", Budget(1_000_000), "long", (-10.0, 2.0), (1, 2000), 300, True)
    assert read("x") == Options("x")


def test_whole_numbers() -> None:
    cases = {"5000": 5000, "1_000_000": 1_000_000, "1e6": 10**6, "-2e1": -20, "2.5e1": 25}
    assert {text: whole_number(text) for text in cases} == cases
    for text in ("many", "1.5", "1e-3", "nan", "inf", ""):
        with pytest.raises((ValueError, OverflowError)):
            whole_number(text)


@pytest.mark.parametrize(
    ("words", "place"),
    [
        ("", "name"),
        ("x --limt 3", "--limit"),
        ("x --steps many", "--steps"),
        ("x --limit 1.5", "--limit"),
        ("x --seeds 1 b", "--seeds"),
        ("x --wind 1", "--wind"),
        ("x --kind shrt", "'short'"),
        ("x y", "y"),
    ],
)
def test_wrong_option_is_named(words: str, place: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        read(*words.split())
    assert caught.value.code == 2 and place in capsys.readouterr().err


def test_checks_of_a_configuration_raise_its_error() -> None:
    with pytest.raises(ConfigError, match="steps: "):
        read("x", "--steps", "0")


@pytest.mark.parametrize("name", COMMANDS)
def test_help_of_every_command(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([name, "--help"]) == 0
    text = capsys.readouterr().out
    assert f"usage: mbn {name} " in text and ("--out" in text) == (" -o " in text)
