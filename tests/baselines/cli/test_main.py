"""However a command ends, it says so in a line, and nothing ends in a traceback."""

from __future__ import annotations

import subprocess
from dataclasses import dataclass
from typing import Annotated, Literal

import pytest
from tyro.conf import Positional, arg

from baselines.cli import fields
from baselines.cli.main import COMMANDS, main
from baselines.cli.options import read_options
from mbn_marl import __version__
from mbn_marl.errors import ConfigError
from tests.baselines.conftest import Refusal
from tests.support.terminal import MBN


def missing(name: str) -> ModuleNotFoundError:
    return ModuleNotFoundError(f"No module named '{name}'", name=name)


def test_version_and_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert __version__ in capsys.readouterr().out
    for words in ([], ["--help"], ["-h"]):
        assert main(words) == 0
        lines = capsys.readouterr().out.splitlines()
        listed = [line.split()[0] for line in lines if line.startswith("  ") and line[2] != " "]
        assert listed == list(COMMANDS)
        assert max(map(len, lines)) <= 80


def test_unknown_command_is_answered_with_a_known_one(refusal: Refusal) -> None:
    error = refusal(["trian"])
    assert "trian: " in error and "did you mean train?" in error
    assert "UTF-8" in refusal(["train", "\udc80"])


@pytest.mark.parametrize(
    ("raised", "code", "parts"),
    [
        (KeyboardInterrupt(), 130, ["interrupted"]),
        (KeyboardInterrupt("runs/a: --resume"), 130, ["interrupted: runs/a: --resume"]),
        (missing("optuna"), 2, ["'optuna'", ".[baselines]"]),
        (missing("ray.tune"), 2, ["'ray.tune'", ".[ray]"]),
        (FileNotFoundError(2, "gone", "a.yaml"), 2, ["a.yaml: gone"]),
        (BrokenPipeError(32, "Broken pipe"), 2, ["Broken pipe"]),
    ],
)
def test_command_ends_with_a_code_and_a_line(
    raised: BaseException,
    code: int,
    parts: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def run(command: object, command_line: str) -> None:
        raise raised

    monkeypatch.setattr(fields.Fields, "run", run)
    assert main(["fields"]) == code
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and all(part in error for part in parts)


@pytest.mark.slow
@pytest.mark.parametrize("words", [["fields"], ["train", "--help"]])
def test_reader_may_leave(words: list[str]) -> None:
    with subprocess.Popen([*MBN, *words], stdout=-1, stderr=-1, text=True) as process:
        assert process.stdout is not None and process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == ""
    assert process.returncode == 1


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


@pytest.mark.parametrize("name", COMMANDS)
def test_help_of_every_command(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([name, "--help"]) == 0
    text = capsys.readouterr().out
    assert f"usage: mbn {name} " in text and ("--out" in text) == (" -o " in text)
