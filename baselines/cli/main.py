"""``mbn``: read the command line, run the command, and say clearly what was wrong."""

import inspect
import os
import shlex
import signal
import sys
import textwrap
from collections.abc import Sequence
from importlib import import_module
from typing import Any

from baselines.cli.options import read_options
from mbn_marl.errors import MbnError, check_text, install, unknown
from mbn_marl.version import __version__

COMMANDS = {
    "fields": "fields:Fields",
    "train": "train:Train",
    "transfer": "train:Transfer",
    "evaluate": "evaluate:Evaluate",
    "benchmark": "compare:Benchmark",
    "compare": "compare:Compare",
    "grid": "grid:Grid",
    "tune": "tune:Tune",
    "report": "compare:Report",
    "runs": "compare:Runs",
    "plan": "plan:Plan",
    "render": "show:Render",
    "replay": "show:Replay",
    "watch": "show:Watch",
    "play": "show:Play",
    "deploy": "deploy:Deploy",
    "warmup": "plan:Warmup",
    "zoo": "evaluate:Zoo",
    "export": "evaluate:Export",
}

EXTRAS = {
    "ray": "ray",
    **dict.fromkeys(("matplotlib", "pygame", "PIL", "imageio_ffmpeg"), "render"),
    **dict.fromkeys(("highspy", "clarabel", "scipy"), "plan"),
    **dict.fromkeys(("mujoco", "coppeliasim_zmqremoteapi_client"), "sim3d"),
    **dict.fromkeys(("sbx", "jax"), "sbx"),
    **dict.fromkeys(("onnxruntime", "onnxscript"), "export"),
}

OWN_PACKAGES = ("mbn_marl", "baselines")
READER_LEFT = 1
WRONG_INPUT = 2
INTERRUPTED = 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``mbn``; return 0, 2 for wrong input, 130 after Ctrl-C, 1 if nobody reads the output."""
    words = sys.argv[1:] if arguments is None else list(arguments)
    try:
        signal.signal(signal.SIGTERM, _leave)
        if not words or words[0] in ("-h", "--help"):
            print(_help())
        elif words[0] == "--version":
            print(f"mbn_marl {__version__}")
        else:
            read_command(words).run(shlex.join(["mbn", *words]))
    except SystemExit as end:  # of tyro after --help or wrong options, of rich if nobody reads
        return int(end.code or READER_LEFT * _reader_left())
    except MbnError as error:
        return _fail(str(error))
    except OSError as error:
        if isinstance(error, BrokenPipeError) and _reader_left(probe="\n"):
            return READER_LEFT
        places = [str(name) for name in (error.filename, error.filename2) if name is not None]
        return _fail(f"{' -> '.join(places)}: {error.strerror}" if places else str(error))
    except ImportError as error:
        package = (error.name or "").split(".")[0]
        if package in ("", *OWN_PACKAGES):
            raise
        hint = f": {install(EXTRAS.get(package, 'baselines'))} brings it"
        return _fail(f"{error}{'' if 'pip install' in str(error) else hint}")
    except KeyboardInterrupt as error:
        print(f"interrupted{': ' if error.args else ''}{error}", file=sys.stderr)
        return INTERRUPTED
    return READER_LEFT * _reader_left()


def read_command(words: Sequence[str]) -> Any:
    name, *options = words
    for word in words:
        check_text(word)
    if name not in COMMANDS:
        raise MbnError(f"{name}: {unknown('command', name, COMMANDS)}")
    return read_options(_command(name), options, f"mbn {name}")


def _command(name: str) -> Any:
    module, of_class = COMMANDS[name].split(":")
    return getattr(import_module(f"baselines.cli.{module}"), of_class)


def _help() -> str:
    lines = ["usage: mbn COMMAND ...", "", "Multi-robot navigation: train, evaluate, plan.", ""]
    for name in COMMANDS:
        summary = " ".join((inspect.getdoc(_command(name)) or "").split("\n\n")[0].split())
        start = f"  {name:10}"
        lines += textwrap.wrap(summary, 80, initial_indent=start, subsequent_indent=" " * 12)
    return "\n".join([*lines, "", "mbn COMMAND --help: its options; mbn --version: the version"])


def _fail(message: str) -> int:
    print(f"mbn: error: {message}", file=sys.stderr)
    return WRONG_INPUT


def _reader_left(probe: str = "") -> bool:
    """Return whether nobody reads the output any more (``mbn zoo | head -1``); then silence it."""
    try:
        print(end=probe, flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return True
    return False


def _leave(number: int, frame: object) -> None:
    # As after Ctrl-C, so that the training processes are ended too.
    raise KeyboardInterrupt
