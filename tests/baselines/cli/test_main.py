"""However a command ends, it says so in a line, and nothing ends in a traceback."""

import os
import signal
import subprocess
from functools import partial
from unittest.mock import Mock

import pytest

from baselines.cli import fields
from baselines.cli.main import COMMANDS, main
from mbn_marl import __version__
from tests.support.pages import MBN


def missing(name: str) -> ModuleNotFoundError:
    return ModuleNotFoundError(f"No module named '{name}'", name=name)


def test_version_and_help(capsys):
    assert main(["--version"]) == 0
    assert __version__ in capsys.readouterr().out
    for words in ([], ["--help"], ["-h"]):
        assert main(words) == 0
        lines = capsys.readouterr().out.splitlines()
        listed = [line.split()[0] for line in lines if line.startswith("  ") and line[2] != " "]
        assert listed == list(COMMANDS)
        assert max(map(len, lines)) <= 80


def test_unknown_command_is_answered_with_a_known_one(refusal):
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
        (ImportError("mujoco: pip install x", name="mujoco"), 2, ["mujoco: pip install x\n"]),
        (FileNotFoundError(2, "gone", "a.yaml"), 2, ["a.yaml: gone"]),
    ],
)
def test_command_ends_with_a_code_and_a_line(raised, code, parts, monkeypatch, capsys):
    monkeypatch.setattr(fields.Fields, "run", Mock(side_effect=raised))
    assert main(["fields"]) == code
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and all(part in error for part in parts)


def test_sigterm_ends_a_command_as_ctrl_c_does(monkeypatch):
    kill = partial(os.kill, os.getpid(), signal.SIGTERM)
    monkeypatch.setattr(fields.Fields, "run", lambda command, command_line: kill())
    assert main(["fields"]) == 130


@pytest.mark.slow
@pytest.mark.parametrize("words", [["fields"], ["train", "--help"]])
def test_reader_may_leave(words):
    with subprocess.Popen([*MBN, *words], stdout=-1, stderr=-1, text=True) as process:
        process.stdout.close()
        assert process.stderr.read() == ""
    assert process.returncode == 1


@pytest.mark.parametrize(
    ("words", "place"),
    [
        ("train ppo", "FIELD"),
        ("train ppo field_03 --stps 3", "--stps"),
        ("train ppo field_03 --steps many", "--steps"),
        ("train ppo field_03 --seed 1.5", "--seed"),
        ("train ppo field_03 --setting Q", "'A'"),
        ("compare --seeds 1 b", "--seeds"),
        ("plan field_03 --wind 1", "--wind"),
        ("plan field_03 y", "y"),
    ],
)
def test_wrong_option_is_named(words, place, capsys):
    assert main(words.split()) == 2 and place in capsys.readouterr().err


@pytest.mark.parametrize("name", COMMANDS)
def test_help_of_every_command(name, capsys):
    assert main([name, "--help"]) == 0
    text = capsys.readouterr().out
    assert f"usage: mbn {name} " in text and ("--out" in text) == (" -o " in text)
