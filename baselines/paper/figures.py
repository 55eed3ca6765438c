"""The figures of a report, from what the runs recorded."""

from __future__ import annotations

from matplotlib.figure import Figure
from pandas import DataFrame

from baselines.compare.records import ordered
from baselines.evaluation.intervals import RETURN_THRESHOLD
from baselines.paper import published
from baselines.paper.trainings import Trainings
from mbn_marl.field import load_field
from mbn_marl.optimum import optimal_return
from mbn_marl.render import figures
from mbn_marl.render.curves import Pair, Panel, learning_curve_panels, pairs


def overview() -> Figure:
    """The paper's ten fields."""
    return figures.fields_figure([load_field(name) for name in published.fields()])


def learning_curves(trainings: Trainings, setting: str) -> Figure | None:
    """The learning curves of a setting, a panel a field; ``None`` if it has no episode."""
    rows = trainings.rows[trainings.rows.setting == setting]
    if rows.empty:
        return None
    panels = {
        field: _panel(trainings, rows[rows.field == field], field)
        for field in trainings.field_names
        if (rows.field == field).any()
    }
    looks = ordered({name: name for name in trainings.algorithms})
    shown = {published.display_name(name): look for name, look in looks.items()}
    return learning_curve_panels(panels, shown, RETURN_THRESHOLD)


def against(trainings: Trainings, first: str, second: str) -> Figure | None:
    """One setting against another, in the cells that both have; ``None`` if there is none.

    A panel an algorithm, with a line for each field, for these fields together, and for the
    paper's number over all ten fields, if the paper has both settings.
    """
    rows = trainings.rows
    counts = rows.groupby(["algorithm", "field", "setting"]).size().unstack()
    counts = counts.reindex(columns=[first, second]).dropna()
    fields = [name for name in trainings.field_names if name in counts.index.unique("field")]
    paper = published.by_algorithm()
    panels = {}
    for algorithm in trainings.algorithms:
        own = rows[rows.algorithm == algorithm]
        both = [field for field in fields if (algorithm, field) in counts.index]
        if both:
            lines = {
                field: _pair(own[own.field == field], first, second)
                if field in both
                else Pair(None, None)
                for field in fields
            }
            lines["these together"] = _pair(own[own.field.isin(both)], first, second)
            if {first, second} <= set(published.settings()):
                cells = [paper.get((algorithm, name), {}) for name in (first, second)]
                lines["paper, all ten"] = Pair(*(cell.get("mean") for cell in cells))
            panels[published.display_name(algorithm)] = lines
    if not panels:
        return None
    return pairs(panels, (f"setting {first}", f"setting {second}"), RETURN_THRESHOLD)


def _pair(rows: DataFrame, first: str, second: str) -> Pair:
    """The mean of the moving means under each of two settings."""
    means = rows.groupby("setting").moving_mean.mean()
    return Pair(float(means[first]), float(means[second]))


def _panel(trainings: Trainings, rows: DataFrame, field: str) -> Panel:
    """The curves of one field, a curve for each algorithm and seed."""
    curves = {
        published.display_name(name): [
            (run.env_steps.to_numpy(), run.moving_mean.to_numpy())
            for _, run in rows[rows.algorithm == name].groupby("seed")
        ]
        for name in trainings.algorithms
        if (rows.algorithm == name).any()
    }
    return Panel(curves, optimal_return(trainings.fields[field]))
