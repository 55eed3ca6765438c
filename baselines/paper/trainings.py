"""The runs that a report is made from, as two tables: one of runs, one of training episodes."""

import io
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from lzma import LZMAError
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas
from numpy.typing import NDArray
from pandas import DataFrame

from baselines.algorithms import find_algorithm
from baselines.compare.records import RunRecord, find_records
from baselines.evaluation.intervals import RETURN_THRESHOLD
from baselines.paper import published
from baselines.runs.files import RunError, read_text, write_text
from baselines.training.config import MOST
from mbn_marl.config import make_config
from mbn_marl.field import catalogue_names
from mbn_marl.files import replacing
from mbn_marl.optimum import optimal_return

CELL = ["algorithm", "setting", "field"]
"""Columns that name a cell of the experiment; its runs differ in their seeds."""
RUN = [*CELL, "seed"]
SMOOTHING = 100
"""Episodes of the moving mean: what Stable-Baselines3 logs as ``rollout/ep_rew_mean``."""
RETURNS = ["return_mean", "return_std", "return_min", "return_max"]
COLUMNS = ["env_steps", "episodes", *RETURNS]
TYPES: dict[str, type] = {
    **{**dict.fromkeys(CELL, str), "seed": int, "env_steps": int},
    **dict.fromkeys(("optimum", "reach", "success_rate", "return_mean"), float),
    **{"finished": bool, "command": str},
}
RUNS_FILE, ROWS_FILE = "runs.csv", "progress.csv.xz"


@dataclass(frozen=True)
class Trainings:
    """Runs, finished or not."""

    # A row for each run: its cell (a field from a file is called by the file's name) and seed, the
    # env-steps recorded, the field's proved optimum, the env-steps at which the moving mean reached
    # the threshold, success and return of the final evaluation with sampled actions, and the exact
    # command. What is not known, or not reached, is NaN.
    runs: DataFrame
    # Those of ``read_progress`` since the first episode, with the cell and the seed of the run.
    rows: DataFrame

    @property
    def algorithms(self) -> list[str]:
        return _known_first(published.ALGORITHMS, self.runs.algorithm)

    @property
    def field_names(self) -> list[str]:
        return _known_first(published.FIELDS, self.runs.field)

    def alike(self) -> "Trainings":
        """Return the runs on the fields that all algorithms of a setting have runs on.

        Algorithms with less than half as many fields as another one do not count.
        """
        begun = self.runs.merge(self.rows[RUN].drop_duplicates())  # others have no numbers yet
        counts = begun.groupby(CELL[:2]).field.transform("nunique")
        begun = begun[2 * counts >= counts.groupby(begun.setting).transform("max")]
        here, there = (
            begun.groupby(names).algorithm.transform("nunique")
            for names in (["setting", "field"], ["setting"])
        )
        runs = begun[here == there]
        return Trainings(runs, self.rows.merge(runs[RUN]))

    def optimum(self, field: str) -> float | None:
        value = self.runs.optimum[self.runs.field == field].iloc[0]
        return None if np.isnan(value) else float(value)

    def save(self, folder: Path) -> None:
        write_text(folder / RUNS_FILE, self.runs.to_csv(index=False))
        rows = self.rows[[*RUN, *COLUMNS]].astype({"env_steps": int, "episodes": int})
        with replacing(folder / ROWS_FILE) as temporary:
            rows.to_csv(temporary, index=False, compression="xz")


class _Training(NamedTuple):
    """A run: its place, its row of ``Trainings.runs``, and its progress."""

    place: Path
    run: dict[str, Any]
    progress: DataFrame


def find_trainings(
    paths: Sequence[Path], note: Callable[[str], None] = lambda text: None
) -> Trainings:
    """Read the runs at ``paths``: run folders, folders with run folders anywhere inside, reports.

    Inside, studies, comparisons and what ``--force`` moved aside are left out. So are runs with
    another environment or other hyperparameters than their setting's. ``note`` says so.
    Of two runs of one cell and seed, one of them unfinished, the finished one is read. A RunError
    names two that are alike otherwise, and what cannot be read.
    """
    paths = list({path.resolve(): path for path in paths}.values())
    reports = [path for path in paths if all((path / f).is_file() for f in (RUNS_FILE, ROWS_FILE))]
    found = [run for path in reports for run in _of_report(path)]
    folders = [path for path in paths if path not in reports]
    if folders or not reports:
        for record in find_records(folders, note, finished=False):
            if changed := _changed(record):
                note(f"left out: {record.run.path}, not the setting's {', '.join(changed)}")
            else:
                found.append(_of_record(record))
    if not found:
        raise RunError(f"{', '.join(map(str, paths))}: no run of a setting as it is")
    found = _one_of_each(found, note)
    begun = [
        progress[progress.moving_mean.notna()].assign(**{name: run[name] for name in RUN})
        for _, run, progress in found
    ]
    runs = DataFrame([run for _, run, _ in found]).astype(TYPES)
    return Trainings(runs, pandas.concat(begun, ignore_index=True))


def _one_of_each(found: Sequence[_Training], note: Callable[[str], None]) -> list[_Training]:
    chosen: dict[tuple[Any, ...], _Training] = {}
    for one in sorted(found, key=lambda training: not training.run["finished"]):
        other = chosen.setdefault(tuple(one.run[name] for name in RUN), one)
        if other is one:
            continue
        if one.run["finished"] or not other.run["finished"]:
            raise RunError(
                f"{other.place} and {one.place} are of the same algorithm, setting, field "
                "and seed; give one of them"
            )
        note(f"left out: {one.place}, unfinished; {other.place} is the same, finished")
    return [one for one in found if any(one is other for other in chosen.values())]


def _changed(record: RunRecord) -> list[str]:
    """Name what differs from the run's setting; the number of worlds may."""
    config, algorithm = record.config, find_algorithm(record.config["algorithm"])
    plain = algorithm.resolve({}, setting=config["setting"], num_envs=config.get("num_envs"))
    numbers = plain.model_dump(mode="json", exclude={"source", "skipped"})
    theirs = config.get("hyperparameters") or {}
    if config.get("hyperparams") is not None and config["setting"] == "B":
        theirs = {}  # tuned ones, of a file that need not be there any more
    different = {
        "hyperparameters": any(theirs.get(name, one) != one for name, one in numbers.items()),
        "environment": make_config(config.get("environment") or plain.environment)
        != make_config(plain.environment),
    }
    return [name for name, differs in different.items() if differs]


def _of_record(record: RunRecord) -> _Training:
    progress, run = read_progress(record.run.progress), record.run
    final = run.evaluation["stochastic"] if run.finished else {}
    cell = {name: record.config[name] for name in RUN}
    if cell["field"] not in catalogue_names():  # a file has its name, marked if it is a known one
        name = Path(cell["field"]).stem
        cell["field"] = f"{name} (file)" if name in catalogue_names() else name
    row = {
        **cell,
        "env_steps": int(progress.env_steps.max()) if len(progress) else 0,
        "optimum": optimal_return(record.run.field),
        "reach": first_reach(progress, RETURN_THRESHOLD),
        **{name: final.get(name) for name in ("success_rate", "return_mean")},
        "finished": run.finished,
        "command": run.command,
    }
    return _Training(run.path, row, progress)


def _of_report(folder: Path) -> list[_Training]:
    """The runs of an earlier report, with their moving means worked out again."""
    runs = _read_table(folder / RUNS_FILE, TYPES)
    types = {name: TYPES[name] for name in RUN} | dict.fromkeys(COLUMNS, float)
    rows = _read_table(folder / ROWS_FILE, types)
    places = rows.groupby(RUN).indices
    found = []
    for run in runs.to_dict("records"):
        progress = rows[COLUMNS].iloc[places.get(tuple(run[name] for name in RUN), [])]
        progress = progress.assign(moving_mean=moving_mean(progress))
        found.append(_Training(folder, run, progress))
    return found


def _read_table(path: Path, types: dict[str, type]) -> DataFrame:
    try:
        return pandas.read_csv(path, usecols=list(types), dtype=types)
    except (OSError, ValueError, EOFError, LZMAError) as error:
        raise RunError(f"{path} cannot be read: {error}") from None


def _known_first(known: Iterable[str], found: Iterable[str]) -> list[str]:
    return list(dict.fromkeys([*known, *sorted(set(found))]))


def read_progress(path: Path) -> DataFrame:
    """Read a ``progress.csv``, a row a window of training; one that is not there gives no rows.

    Returns are true team returns in reward units, NaN without an episode. A RunError names the
    file, and the column or the line that is not as it should be.
    """
    text = read_text(path) if path.exists() else ",".join(COLUMNS)
    try:
        table = pandas.read_csv(io.StringIO(text), dtype=str, keep_default_na=False)
    except ValueError as error:
        raise RunError(f"{path} cannot be read: {error}") from None
    if missing := [name for name in COLUMNS if name not in table]:
        raise RunError(f"{path} has no column {', '.join(missing)}")
    words = table[COLUMNS]
    rows = words.apply(pandas.to_numeric, errors="coerce").astype(float)
    none = (rows.isna() & (words != "nan")).any(axis=1)
    finite = (rows[RETURNS].abs() <= MOST).all(axis=1)
    within = rows.env_steps.between(0, MOST) & rows.episodes.between(0, MOST)
    wrong = ~within | ~((rows.episodes == 0) | finite)
    for bad, problem in (
        (none, "a number is missing or is none"),
        (wrong, "env_steps and episodes have to be 0 or more, with finite returns"),
    ):
        if bad.any():
            line = int(bad.to_numpy().argmax())
            raise RunError(f"{path}, line {line + 2}: {problem}: {dict(words.loc[line])}")
    if not (np.diff(rows.env_steps) > 0).all():
        raise RunError(f"{path}: env_steps have to increase from row to row")
    return rows.assign(moving_mean=moving_mean(rows))


def moving_mean(rows: DataFrame) -> NDArray[np.float64]:
    """The mean return of the latest episodes at each row, (k,) reward units; NaN before the first.

    It is over the fewest whole rows, up to that one, that hold at least ``SMOOTHING`` episodes.
    """
    counts = rows.episodes.to_numpy()
    returns = np.where(counts > 0, counts * rows.return_mean, 0.0)
    episodes, total = (np.concatenate([[0.0], np.cumsum(each)]) for each in (counts, returns))
    starts = np.searchsorted(episodes, episodes[1:] - SMOOTHING, side="right") - 1
    starts = np.maximum(starts, 0)
    with np.errstate(invalid="ignore"):
        means: NDArray[np.float64] = (total[1:] - total[starts]) / (episodes[1:] - episodes[starts])
    return means


def first_reach(rows: DataFrame, threshold: float) -> float:
    """Env-steps at which the moving mean of ``SMOOTHING`` episodes reaches it; NaN for never."""
    reached = (rows.episodes.cumsum() >= SMOOTHING) & (rows.moving_mean >= threshold)
    return float(rows.env_steps[reached].min())
