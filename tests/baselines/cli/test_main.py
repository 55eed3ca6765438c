"""However a command ends, it says so in a line, and nothing ends in a traceback."""

from __future__ import annotations

import subprocess

import pytest

from baselines.cli import fields
from baselines.cli.main import COMMANDS, main
from mbn_marl import __version__
from tests.baselines.conftest import Refusal
from tests.support.terminal import MBN


def test_the_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert __version__ in capsys.readouterr().out


def test_help_lists_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    for words in ([], ["--help"], ["-h"]):
        assert main(words) == 0
        lines = capsys.readouterr().out.splitlines()
        listed = [line.split()[0] for line in lines if line.startswith("  ") and line[2] != " "]
        assert listed == list(COMMANDS)
        assert max(map(len, lines)) <= 80


def test_an_unknown_command_is_answered_with_a_known_one(refusal: Refusal) -> None:
    for word, meant in (("trian", "train"), ("evalute", "evaluate")):
        error = refusal([word])
        assert f"{word}: " in error and f"did you mean {meant}?" in error


def test_a_command_ends_with_a_code_and_a_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def missing(name: str) -> ModuleNotFoundError:
        return ModuleNotFoundError(f"No module named '{name}'", name=name)

    raised: BaseException
    for raised, code, parts in (
        (KeyboardInterrupt(), 130, ["interrupted"]),
        (KeyboardInterrupt("runs/a: --resume"), 130, ["interrupted: runs/a: --resume"]),
        (missing("optuna"), 2, ["'optuna'", ".[baselines]"]),
        (missing("ray.tune"), 2, ["'ray.tune'", ".[ray]"]),
        (FileNotFoundError(2, "gone", "a.yaml"), 2, ["a.yaml: gone"]),
        (BrokenPipeError(32, "Broken pipe"), 2, ["Broken pipe"]),
    ):

        def run(command: object, command_line: str, raised: BaseException = raised) -> None:
            raise raised

        monkeypatch.setattr(fields.Fields, "run", run)
        assert main(["fields"]) == code
        error = capsys.readouterr().err
        assert error.count("\n") == 1 and all(part in error for part in parts)


@pytest.mark.slow
@pytest.mark.parametrize("words", [["fields"], ["train", "--help"]])
def test_a_reader_may_leave(words: list[str]) -> None:
    with subprocess.Popen([*MBN, *words], stdout=-1, stderr=-1, text=True) as process:
        assert process.stdout is not None and process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == ""
    assert process.returncode == 1
