"""Fixtures of the tests of baselines."""

import pytest

from baselines.cli import main
from tests.support.runs import tiny_runs as tiny_runs


@pytest.fixture
def refusal(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)

    def run(words):
        assert main(words) == 2
        error = capsys.readouterr().err
        assert error.startswith("mbn: error: ") and "Traceback" not in error
        return error

    return run
