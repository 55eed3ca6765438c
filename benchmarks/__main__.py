"""``python -m benchmarks SUBJECT``: the measurements and studies of the pages of results."""

import shlex
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Any

from baselines.cli.options import read_options
from mbn_marl.errors import MbnError, unknown

PROGRAM = "python -m benchmarks"

SUBJECTS = {
    "speed": ("speed", "Speed", "engine and adapters, against a plain loop and peers"),
    "study": ("studies.learning", "Study", "comparisons of learning, benchmarks/studies/*.yaml"),
    "splits": ("splits", "Splits", "the frozen fields of a benchmark: made, proved, verified"),
    "leaderboard": ("leaderboard", "Leaderboard", "the page of the committed results"),
    "strip": ("strip", "Strip", "the figures of the pages of results"),
    "tables": ("tables", "Tables", "the tables of the pages of results"),
    "gpu": ("gpu", "Gpu", "the engine on CUDA"),
}
USAGE = "usage: python -m benchmarks SUBJECT [options]    (SUBJECT --help lists the options)\n\n"
USAGE += "\n".join(f"  {name:<12}{about}" for name, (*_, about) in SUBJECTS.items())


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a benchmark; return 0, 1 for wrong frozen fields, 2 for wrong input, 130 after Ctrl-C."""
    words = sys.argv[1:] if arguments is None else list(arguments)
    if not words or words[0] in ("-h", "--help"):
        print(USAGE)
        return 0
    subject, *options = words
    try:
        if subject not in SUBJECTS:
            raise MbnError(f"{subject}: {unknown('subject', subject, SUBJECTS)}")
        benchmark: Any = read_options(benchmark_class(subject), options, f"{PROGRAM} {subject}")
        return 0 if benchmark.run(f"{PROGRAM} {shlex.join(words)}") else 1
    except (MbnError, OSError) as error:
        print(f"benchmarks: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


def benchmark_class(subject: str) -> Any:
    module, name, _ = SUBJECTS[subject]
    return getattr(import_module(f"benchmarks.{module}"), name)


if __name__ == "__main__":
    sys.exit(main())
