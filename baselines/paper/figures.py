"""The figures of a report, from what the runs recorded."""

from __future__ import annotations

from matplotlib.figure import Figure

from baselines.compare.records import ordered
from baselines.evaluation.intervals import RETURN_THRESHOLD
from baselines.paper import published
from baselines.paper.trainings import Trainings
from mbn_marl.field import load_field
from mbn_marl.render import curves, figures
from mbn_marl.render.curves import Pair, Panel


def overview() -> Figure:
    """The paper's ten fields."""
    return figures.fields_figure([load_field(name) for name in published.FIELDS])


def learning_curves(trainings: Trainings, setting: str) -> Figure | None:
    """The learning curves of a setting, a panel a field; ``None`` if it has no episode."""
    rows = trainings.rows[trainings.rows.setting == setting]
    if rows.empty:
        return None
    groups, panels = rows.groupby(["field", "algorithm"]), {}
    for field in trainings.field_names:
        found = {
            published.display_name(name): [
                (run.env_steps.to_numpy(), run.moving_mean.to_numpy())
                for _, run in groups.get_group((field, name)).groupby("seed")
            ]
            for name in trainings.algorithms
            if (field, name) in groups.groups
        }
        if found:
            panels[field] = Panel(found, trainings.optimum(field))
    looks = ordered({name: name for name in trainings.algorithms})
    shown = {published.display_name(name): look for name, look in looks.items()}
    return curves.learning_curve_panels(panels, shown, RETURN_THRESHOLD)


def against(trainings: Trainings, first: str, second: str) -> Figure | None:
    """One setting against another, in the cells that both have; ``None`` if there is none.

    A panel an algorithm, with a line for each field, for these fields together, and for the
    paper's number over all ten fields, if the paper has both settings.
    """
    rows = trainings.rows[trainings.rows.setting.isin([first, second])]
    means = rows.pivot_table("moving_mean", ["algorithm", "field"], "setting")
    means = means.reindex(columns=[first, second]).dropna()
    fields = [name for name in trainings.field_names if name in means.index.unique("field")]
    paper = published.by_algorithm()
    panels = {}
    for algorithm in trainings.algorithms:
        both = [field for field in fields if (algorithm, field) in means.index]
        if both:
            lines = {
                field: Pair(*means.loc[algorithm, field]) if field in both else Pair(None, None)
                for field in fields
            }
            own = rows[(rows.algorithm == algorithm) & rows.field.isin(both)]
            together = own.groupby("setting").moving_mean.mean()
            lines["these together"] = Pair(together[first], together[second])
            if {first, second} <= set(published.SETTINGS):
                cells = [paper.get((algorithm, name), {}) for name in (first, second)]
                lines["paper, all ten"] = Pair(*(cell.get("mean") for cell in cells))
            panels[published.display_name(algorithm)] = lines
    if not panels:
        return None
    return curves.pairs(panels, (f"setting {first}", f"setting {second}"), RETURN_THRESHOLD)
