"""``python -m benchmarks SUBJECT``: speed, learning, planning and reliability, against targets."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from difflib import get_close_matches
from importlib import import_module
from typing import Any

import tyro

from mbn_marl.errors import MbnError

SUBJECTS = {
    "speed": ("speed.measure", "Speed", "engine and adapters, against a plain loop and peers"),
    "learning": ("studies.learning", "Learning", "one setting on all ten fields"),
    "sharing": ("studies.learning", "Sharing", "the ways to share parameters"),
    "ablations": ("studies.learning", "Ablations", "what the recorded setting is made of"),
    "population": ("studies.population", "Population", "the best policies within a time"),
    "planning": ("planning", "Planning", "proofs and plans for the ten fields and random ones"),
    "grid": ("grid", "GridCosts", "what the schedulers of `mbn grid` cost"),
    "capacity": ("capacity", "Capacity", "how long the paper's grid takes on many machines"),
    "gpu": ("gpu", "Gpu", "the engine on CUDA"),
    "kills": ("reliability.kills", "Kills", "trainings killed at random moments and resumed"),
    "corruption": ("reliability.corruption", "Corruption", "damaged files"),
    "endurance": ("reliability.endurance", "Endurance", "a billion env-steps with resets"),
    "fuzz": ("reliability.fuzz", "Fuzz", "input that nobody meant"),
}
"""For each subject its module, its class, and what it measures."""
USAGE = "\n".join(
    [
        "usage: python -m benchmarks SUBJECT [options]    (SUBJECT --help lists the options)",
        "",
        *(f"  {name:<12}{about}" for name, (*_, about) in SUBJECTS.items()),
    ]
)
FAILED, WRONG_INPUT, INTERRUPTED = 1, 2, 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a benchmark with ``arguments``, by default those of the process.

    Returns:
        The exit code: 0, 1 for a broken promise of reliability, 2 for wrong input, 130 after
        Ctrl-C.
    """
    words = sys.argv[1:] if arguments is None else list(arguments)
    if not words or words[0] in ("-h", "--help"):
        print(USAGE)
        return 0
    if words[0] not in SUBJECTS:
        close = get_close_matches(words[0], SUBJECTS)
        hint = f"; did you mean {close[0]}?" if close else ""
        return _fail(f"subject: {words[0]} is none{hint}\n{USAGE}")
    command = shlex.join(["python", "-m", "benchmarks", *words])
    benchmark = tyro.cli(
        benchmark_class(words[0]),
        args=words[1:],
        prog=f"python -m benchmarks {words[0]}",
        config=(tyro.conf.FlagCreatePairsOff,),
    )
    try:
        return 0 if benchmark.run(command) else FAILED
    except (MbnError, OSError) as error:
        return _fail(str(error))
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return INTERRUPTED


def benchmark_class(subject: str) -> Any:
    """Return the dataclass of a subject; only its own module is loaded."""
    module, name, _ = SUBJECTS[subject]
    return getattr(import_module(f"benchmarks.{module}"), name)


def _fail(message: str) -> int:
    print(f"benchmarks: error: {message}", file=sys.stderr)
    return WRONG_INPUT


if __name__ == "__main__":
    sys.exit(main())
