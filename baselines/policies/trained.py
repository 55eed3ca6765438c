"""Trained policies: of runs, and of the zoo, whose entries are small runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from baselines.algorithms import find_algorithm
from baselines.policies.policy import Origin, TrainedPolicy
from baselines.runs.files import RunError, read_json, reading
from baselines.runs.folder import RunFolder
from mbn_marl.config import make_config
from mbn_marl.errors import MbnError, unknown

ENTRIES = Path(__file__).parents[1] / "zoo"
PREFIX = "zoo:"
CARD = "card.json"


def entry_names() -> list[str]:
    """The names of the zoo's entries, sorted."""
    return sorted(path.parent.name for path in ENTRIES.glob(f"*/{CARD}"))


def read_card(name: str) -> dict[str, Any]:
    """The facts of an entry: see :func:`baselines.zoo.make.make_card`."""
    card: dict[str, Any] = read_json(ENTRIES / name / CARD)
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
    return RunFolder.open(ENTRIES / name)


def load_trained(run: Path | RunFolder) -> TrainedPolicy:
    """Load the latest policy of a run, with its origin.

    Raises:
        RunError: there is no run, or it has saved no policy yet.
    """
    folder = run if isinstance(run, RunFolder) else RunFolder.open(run)
    with reading(folder.path / "config.json"):
        algorithm = find_algorithm(folder.config["algorithm"])
        origin = Origin(folder.fields, make_config(folder.config["environment"]))
    while True:
        place = folder.policy
        try:
            policy: TrainedPolicy = algorithm.load_policy(place)
        except RunError:
            if folder.policy == place:
                raise
            continue  # the run has written its next checkpoint meanwhile, and removed this one
        policy.origin = origin
        return policy


def is_trained(source: str) -> bool:
    """Return whether a source is one trained policy: of the zoo, or a run's folder."""
    return source.startswith(PREFIX) or Path(source).is_dir()
