"""Options are read from dataclasses; what is wrong is said in one line that names it."""

from __future__ import annotations

import os
from dataclasses import dataclass
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
    out: Path | None = None
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


def test_whole_numbers() -> None:
    cases = {"5000": 5000, "1_000_000": 1_000_000, "1e6": 10**6, "-2e1": -20, "2.5e1": 25}
    assert {text: whole_number(text) for text in cases} == cases
    for text in ("many", "1.5", "1e-3", "nan", "inf", ""):
        with pytest.raises((ValueError, OverflowError)):
            whole_number(text)


def test_a_wrong_option_is_one_line_that_names_it() -> None:
    for words, place in (
        ("", "NAME"),
        ("--limt 3", "NAME"),
        ("x --steps many", "--steps"),
        ("x --limit 1.5", "--limit"),
        ("x --seeds 1 b", "--seeds"),
        ("x --wind 1 c", "--wind"),
        ("x --wind 1", "--wind"),
        ("x --steps", "--steps"),
        (
            "x --kind shrt",
            "--kind: 'shrt': unknown choice (did you mean short?); known: short, long",
        ),
        ("x --limt 3", "did you mean --limit"),
        ("x --ot 3", "did you mean --out"),
        ("x y", "y"),
    ):
        with pytest.raises(UsageError) as caught:
            read(*words.split())
        message = str(caught.value)
        assert place in message and "\n" not in message and "--  " not in message, message
        assert message.endswith("; see mbn do --help") and len(message) < 120
    with pytest.raises(ConfigError, match="steps: "):
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


@pytest.mark.parametrize("name", COMMANDS)
def test_options_mean_one_thing_in_all_commands(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([name, "--help"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert ("--out" in text) == ("-o PATH, --out PATH" in text)
    if "--processes" in text:
        assert "each takes one core" in text and f"(default: {os.cpu_count()})" in text
    repeated = {"fields": "[FIELD ...]", "replay": "EPISODE ...", "report": "RUN ..."}
    assert repeated.get(name, "") in text.split("positional arguments")[0]


def test_the_help_of_every_command_is_whole(capsys: pytest.CaptureFixture[str]) -> None:
    for command in COMMANDS:
        assert main([command, "--help"]) == 0
        text = capsys.readouterr().out
        for riddle in ("None", "(default: )", "{None}", "``", ":class:", ":data:", ":func:"):
            assert riddle not in text, (command, riddle)
