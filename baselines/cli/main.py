"""Reads the command line, runs the command, and says clearly what was wrong."""

from __future__ import annotations

import shlex
import signal
import sys
from collections.abc import Sequence
from typing import Annotated

import tyro
from tyro.conf import subcommand

from baselines.cli.compare import Compare
from baselines.cli.deploy import Deploy
from baselines.cli.evaluate import Evaluate
from baselines.cli.fields import Fields
from baselines.cli.grid import Grid
from baselines.cli.plan import Plan
from baselines.cli.render import Render
from baselines.cli.replay import Replay
from baselines.cli.report import Report
from baselines.cli.train import Train
from baselines.cli.transfer import Transfer
from baselines.cli.tune import Tune
from baselines.cli.watch import Play, Watch
from baselines.cli.zoo import Zoo
from mbn_marl.errors import MbnError

Command = (
    Annotated[Fields, subcommand("fields")]
    | Annotated[Train, subcommand("train")]
    | Annotated[Transfer, subcommand("transfer")]
    | Annotated[Evaluate, subcommand("evaluate")]
    | Annotated[Compare, subcommand("compare")]
    | Annotated[Grid, subcommand("grid")]
    | Annotated[Tune, subcommand("tune")]
    | Annotated[Report, subcommand("report")]
    | Annotated[Plan, subcommand("plan")]
    | Annotated[Render, subcommand("render")]
    | Annotated[Replay, subcommand("replay")]
    | Annotated[Watch, subcommand("watch")]
    | Annotated[Play, subcommand("play")]
    | Annotated[Deploy, subcommand("deploy")]
    | Annotated[Zoo, subcommand("zoo")]
)

OWN_PACKAGES = ("mbn_marl", "baselines")
WRONG_INPUT = 2
INTERRUPTED = 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``mbn`` with ``arguments``, by default those of the process.

    Returns:
        The exit code: 0, 2 for wrong input (one message, no traceback), 130 after Ctrl-C.

    Raises:
        SystemExit: after ``--help``, and for a command line that cannot be parsed.
    """
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    command: Command = tyro.cli(
        Command,
        args=arguments,
        prog="mbn",
        description="Multi-robot navigation: fields, training, evaluation, comparison, pictures.",
        config=(tyro.conf.FlagCreatePairsOff,),
    )
    signal.signal(signal.SIGTERM, _leave)
    try:
        command.run(shlex.join(["mbn", *arguments]))
    except MbnError as error:
        return _fail(str(error))
    except OSError as error:
        return _fail(str(error) if error.filename is None else _of_file(error))
    except ImportError as error:
        if error.name is None or error.name.split(".")[0] in OWN_PACKAGES:
            raise
        return _fail(f"{error}; the extras of this package bring it: pip install 'mbn-marl[all]'")
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return INTERRUPTED
    return 0


def _fail(message: str) -> int:
    print(f"mbn: error: {message}", file=sys.stderr)
    return WRONG_INPUT


def _of_file(error: OSError) -> str:
    """The place first, as in all messages, and no number."""
    places = [str(name) for name in (error.filename, error.filename2) if name is not None]
    return f"{' -> '.join(places)}: {error.strerror}"


def _leave(number: int, frame: object) -> None:
    """End as after Ctrl-C, so that the training processes are ended too."""
    raise KeyboardInterrupt
