"""Finding the zoo's policies, beside the runs of one's own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from baselines.runs.files import read_json
from baselines.runs.folder import RunFolder
from mbn_marl.errors import MbnError, unknown

FOLDER = Path(__file__).parent
PREFIX = "zoo:"
CARD = "card.json"


def entry_names() -> list[str]:
    """The names of the entries, sorted."""
    return sorted(path.parent.name for path in FOLDER.glob(f"*/{CARD}"))


def read_card(name: str) -> dict[str, Any]:
    """The facts of an entry: see :func:`baselines.zoo.make.make_card`."""
    card: dict[str, Any] = read_json(FOLDER / name / CARD)
    return card


def open_run(source: str) -> RunFolder:
    """The run that ``source`` means: ``zoo:NAME``, or the path of a run folder.

    Raises:
        MbnError: there is no such entry; the message lists those there are.
        RunError: there is no run at the path.
    """
    if not source.startswith(PREFIX):
        return RunFolder.open(Path(source))
    name, known = source.removeprefix(PREFIX), entry_names()
    if name not in known:
        raise MbnError(f"{source}: {unknown('policy', name, known)}")
    return RunFolder.open(FOLDER / name)
