"""The figures of a report, from what the runs recorded."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.figure import Figure

from baselines.evaluation.intervals import RETURN_THRESHOLD
from baselines.paper import published
from baselines.paper.summary import Summary, moving_mean, of_moving_means
from baselines.paper.tables import algorithms_of, fields_of
from baselines.paper.trainings import Training, windows_of
from mbn_marl.field import load_field
from mbn_marl.optimum import optimal_return
from mbn_marl.render import figures
from mbn_marl.render.figures import Pair, Panel


def overview() -> Figure:
    """The paper's ten fields."""
    return figures.fields_figure([load_field(name) for name in published.fields()])


def learning_curves(trainings: Sequence[Training], setting: str) -> Figure | None:
    """The learning curves of a setting, a panel a field; ``None`` if it has no episode."""
    runs = [
        run
        for run in trainings
        if run.cell.setting == setting and run.windows.with_episodes().episodes.size
    ]
    if not runs:
        return None
    panels = {
        field: _panel([run for run in runs if run.cell.field == field])
        for field in fields_of(trainings)
        if any(run.cell.field == field for run in runs)
    }
    names = [published.display_name(name) for name in algorithms_of(trainings)]
    return figures.learning_curve_panels(panels, names, RETURN_THRESHOLD)


def against(trainings: Sequence[Training], first: str, second: str) -> Figure | None:
    """One setting against another, in the cells that both have; ``None`` if there is none.

    A panel an algorithm, with a line for each field, for these fields together, and for the
    paper's number over all ten fields, if the paper has both settings.
    """
    cells = {run.cell for run in trainings if run.windows.with_episodes().episodes.size}
    both = {
        cell[::2]
        for cell in cells
        if cell.setting == first and cell._replace(setting=second) in cells
    }
    fields = [name for name in fields_of(trainings) if any(name == field for _, field in both)]
    panels = {}
    for algorithm in algorithms_of(trainings):
        own = [field for field in fields if (algorithm, field) in both]
        if own:
            runs = [run for run in trainings if run.cell.algorithm == algorithm]
            lines = {
                field: _pair(runs, [field] if field in own else [], first, second)
                for field in fields
            }
            lines["these together"] = _pair(runs, own, first, second)
            if {first, second} <= set(published.settings()):
                lines["paper, all ten"] = Pair(
                    *(_mean(published.of_algorithm(algorithm, name)) for name in (first, second))
                )
            panels[published.display_name(algorithm)] = lines
    if not panels:
        return None
    return figures.pairs(panels, (f"setting {first}", f"setting {second}"), RETURN_THRESHOLD)


def _pair(runs: Sequence[Training], fields: Sequence[str], first: str, second: str) -> Pair:
    """The mean of the moving means in ``fields`` under each of two settings."""
    chosen = [
        [run for run in runs if run.cell.setting == setting and run.cell.field in fields]
        for setting in (first, second)
    ]
    return Pair(*(_mean(of_moving_means(windows_of(group))) for group in chosen))


def _mean(summary: Summary | None) -> float | None:
    return None if summary is None else summary.mean


def _panel(runs: Sequence[Training]) -> Panel:
    """The curves of one field, a curve for each algorithm and seed."""
    curves = {
        published.display_name(name): [
            moving_mean(run.windows) for run in runs if run.cell.algorithm == name
        ]
        for name in algorithms_of(runs)
    }
    present = {name: seeds for name, seeds in curves.items() if seeds}
    return Panel(present, optimal_return(runs[0].field))
