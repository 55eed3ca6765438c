"""Options are read from dataclasses; what is wrong is said in one line that names it."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal

import pytest
from tyro.conf import Positional, arg

from baselines.cli.main import COMMANDS, main
from baselines.cli.options import UsageError, read_options, whole_number
from mbn_marl.errors import ConfigError


@dataclass(frozen=True)
class Budget:
    """How long a run is.

    Attributes:
        steps: how many steps are taken, all in all and on the whole, however long that may
            last.
        kind: of run.
    """

    steps: int = 5
    kind: Literal["short", "long"] = "short"

    def __post_init__(self) -> None:
        """Check the numbers."""
        if self.steps < 1:
            raise ConfigError("budget", [f"steps: at least 1, not {self.steps}"])


@dataclass(frozen=True)
class Options:
    """Do something."""

    name: Positional[Annotated[str, arg(metavar="NAME")]]
    """Whose name is long enough that this text has more than a line, and when it is wrapped no
    line of it is short."""
    budget: Annotated[Budget, arg(name="")] = Budget()
    wind: tuple[float, float] = (0.0, 0.5)
    """Speed and direction."""
    seeds: tuple[int, ...] = ()
    """Several."""
    limit: int | None = None
    """At most."""
    out: Annotated[Path | None, arg(aliases=["-o"])] = None
    """Where."""
    quiet: bool = False
    """Say nothing."""


def read(*words: str) -> Options:
    """The options of a command line."""
    return read_options(Options, words, "mbn do")


def test_options_of_a_configuration_are_those_of_its_command() -> None:
    words = ("x", "--steps", "1e6", "--kind", "long", "--seeds", "1", "2_000", "--limit", "3e2")
    found = read(*words, "--wind", "-1e1", "2", "-o", "a/b", "--quiet")
    assert found == Options(
        "x", Budget(1_000_000, "long"), (-10.0, 2.0), (1, 2000), 300, Path("a/b"), True
    )
    assert read("x") == Options("x")


@pytest.mark.parametrize(
    ("text", "number"),
    [("5000", 5000), ("1_000_000", 1_000_000), ("1e6", 10**6), ("-2e1", -20), ("2.5e1", 25)],
)
def test_whole_numbers(text: str, number: int) -> None:
    assert whole_number(text) == number


@pytest.mark.parametrize("text", ["many", "1.5", "1e-3", "nan", "inf", ""])
def test_what_is_no_whole_number(text: str) -> None:
    with pytest.raises((ValueError, OverflowError)):
        whole_number(text)


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        ([], ["needed: NAME"]),
        (["--limt", "3"], ["needed: NAME"]),
        (["x", "--steps", "many"], ["--steps", "'many'", "whole number"]),
        (["x", "--limit", "1.5"], ["--limit", "'1.5'", "whole number"]),
        (["x", "--seeds", "1", "b"], ["--seeds", "'b'", "whole number"]),
        (["x", "--wind", "1", "c"], ["--wind", "'c'", "a number"]),
        (["x", "--wind", "1"], ["--wind", "2 value"]),
        (["x", "--steps"], ["--steps", "1 value"]),
        (["x", "--kind", "wide"], ["--kind", "'wide'", "'short', 'long'"]),
        (["x", "--limt", "3"], ["--limt", "did you mean --limit"]),
        (["x", "--ot", "3"], ["--ot", "did you mean --out"]),
        (["x", "y"], ["unknown", "y"]),
    ],
)
def test_a_wrong_option_is_one_line_that_names_it(words: list[str], parts: list[str]) -> None:
    with pytest.raises(UsageError) as caught:
        read(*words)
    message = str(caught.value)
    assert all(part in message for part in parts), message
    assert "\n" not in message and "--  " not in message and "---" not in message
    assert message.endswith("; see mbn do --help") and len(message) < 120


def test_what_a_configuration_refuses_is_said_as_it_says_it() -> None:
    with pytest.raises(ConfigError, match="steps: at least 1, not 0"):
        read("x", "--steps", "0")


def test_help_is_plain(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        read("--help")
    assert not caught.value.code
    lines = [line.rstrip() for line in capsys.readouterr().out.splitlines()]
    words = " ".join(" ".join(lines).split())
    assert "--steps INT How many steps are taken, all in all and on the whole" in words
    assert "(default: 5)" in words and "(default: 0 0.5)" in words
    assert "--limit INT At most. -o PATH, --out PATH Where. --quiet Say nothing." in words


@pytest.mark.parametrize("command", COMMANDS)
def test_the_help_of_every_command_is_whole(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([command, "--help"]) == 0
    text = capsys.readouterr().out
    for riddle in ("None", "(default: )", "{None}", "``", ":class:", ":data:", ":func:"):
        assert riddle not in text, riddle
    lines = [line.rstrip() for line in text.splitlines()]
    assert max(map(len, lines)) <= 80
    # A line is only broken where the next word does not fit.
    for above, below in pairwise(lines):
        indent = len(below) - len(below.lstrip())
        if indent >= 8 and above[indent - 2 : indent] == "  " and above[indent:]:
            assert len(above) + 1 + len(below.split()[0]) >= 80, (above, below)
