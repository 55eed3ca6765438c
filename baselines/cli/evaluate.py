"""``mbn evaluate``: fresh episodes of a trained policy, or of a classical one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

from mbn_marl.optimum import optimality_gap

if TYPE_CHECKING:
    from baselines.evaluation.policy import Policy
    from mbn_marl.field import Field


@dataclass(frozen=True)
class Evaluate:
    """Evaluate a policy on fresh episodes, with sampled and with mean actions."""

    source: Positional[Annotated[str, arg(metavar="RUN|greedy|planner")]]
    """The folder of a run; zoo:NAME, a policy of `mbn zoo`; greedy, nearest ROIs first; or planner,
    the best plan, followed in closed loop."""
    field: str | None = None
    """For greedy and planner: a name of `mbn fields`, or a field file."""
    episodes: int = 100
    """How many episodes."""
    seed: int | None = None
    """Of the episodes; by default the seed that every run's final evaluation has."""
    json: Path | None = None
    """Write every episode to this file; with --wind-speeds by default RUN/wind.json."""
    record: Path | None = None
    """A new folder for the best, the median and the worst episode with sampled actions, as files
    for `mbn replay`."""
    wind_speeds: str | None = None
    """Wind speeds to evaluate at, such as 0,0.1,..,0.5 (units/step per step)."""
    wind_angle: float = 30.0
    """The direction of that wind, degrees from +x."""
    figure: Path | None = None
    """With --wind-speeds: the picture of an episode at each, by default RUN/wind.png."""
    trust: bool = False
    """Load pickled files of the run even if you did not make them; they can run any code."""
    force: bool = False
    """If an output exists, move it aside (to OUT.1, OUT.2, ...)."""

    def run(self, command_line: str) -> None:
        """Evaluate, print the summaries, and write the file if one is asked for."""
        from baselines.evaluation.evaluate import EVALUATION_SEED
        from baselines.zoo.entries import PREFIX
        from mbn_marl.errors import ConfigError

        if self.episodes < 1:
            raise ConfigError("evaluation", [f"episodes: at least 1, not {self.episodes}"])
        if self.figure is not None and self.wind_speeds is None:
            raise ConfigError("evaluation", ["figure: allowed with --wind-speeds"])
        if self.record is not None and self.wind_speeds is not None:
            raise ConfigError("evaluation", ["record: allowed without --wind-speeds"])
        files = (self.json, self.figure)
        homeless = self.field is not None or self.source.startswith(PREFIX)
        if self.wind_speeds is not None and homeless and None in files:
            problem = "json, figure: of a policy without a run folder in wind, name both"
            raise ConfigError("evaluation", [problem])
        subject = self._subject()
        seed = EVALUATION_SEED if self.seed is None else self.seed
        if self.wind_speeds is None:
            self._evaluate(subject, seed, command_line)
        else:
            self._evaluate_in_wind(subject, seed, command_line, self.wind_speeds)

    def _subject(self) -> _Subject:
        """What is evaluated, and where."""
        from baselines.classical.controller import CLASSICAL, make_classical
        from baselines.evaluation.policy import load_policy
        from baselines.zoo.entries import open_run
        from mbn_marl.errors import ConfigError
        from mbn_marl.field import load_field

        if (self.source in CLASSICAL) != (self.field is not None):
            names = " and ".join(CLASSICAL)
            raise ConfigError("evaluation", [f"field: for {names}, which need it, and no other"])
        if self.field is not None:
            field = load_field(self.field)
            return _Subject(make_classical(self.source, field, {}), field, {}, Path())
        run = open_run(self.source, trust=self.trust)
        return _Subject(load_policy(run), run.field, run.config["environment"], run.path)

    def _evaluate(self, subject: _Subject, seed: int, command_line: str) -> None:
        """Evaluate as the policy was trained."""
        from baselines.evaluation.evaluate import evaluate_both
        from baselines.runs.files import claim_folder, write_json
        from mbn_marl.config import make_config
        from mbn_marl.files import claim_file
        from mbn_marl.optimum import optimal_return

        if self.json is not None:
            claim_file(self.json, force=self.force)
        if self.record is not None:
            claim_folder(self.record, force=self.force)
        results = evaluate_both(
            subject.policy, subject.field, subject.settings, episodes=self.episodes, seed=seed
        )
        optimum = optimal_return(subject.field, make_config(subject.settings))
        summaries = [result.summary() for result in results.values()]
        print_evaluations(summaries, title=self.source, optimum=optimum)
        if self.json is not None:
            episodes = {name: result.to_json() for name, result in results.items()}
            gaps = {
                name: optimality_gap(result.summary()["return_mean"], optimum)
                for name, result in results.items()
            }
            heading = {"command": command_line, "optimum": optimum, "optimality_gap": gaps}
            write_json(self.json, {**heading, **episodes})
        if self.record is not None:
            self._record(subject, seed, self.record)

    def _record(self, subject: _Subject, seed: int, folder: Path) -> None:
        """Write the most telling episodes as recordings."""
        from baselines.evaluation.evaluate import record_evaluation
        from mbn_marl.episode import save_episode

        recorded = record_evaluation(
            subject.policy,
            subject.field,
            subject.settings,
            episodes=self.episodes,
            seed=seed,
            source=self.source if self.field else f"{self.source}, sampled actions",
        )
        for name, episode in recorded.items():
            save_episode(episode, folder / f"{name}.json")
        print(f"recorded: {', '.join(recorded)} in {folder}")

    def _evaluate_in_wind(
        self, subject: _Subject, seed: int, command_line: str, speeds: str
    ) -> None:
        """Evaluate at several wind speeds; write the episodes and the picture."""
        from baselines.evaluation.wind import evaluate_in_wind, parse_speeds, write_panels
        from baselines.runs.files import write_json
        from mbn_marl.files import claim_file
        from mbn_marl.render.figures import check_name

        winds = parse_speeds(speeds), self.wind_angle
        where = subject.policy, subject.field, subject.settings
        figure = check_name(self.figure or subject.home / "wind.png")
        results = self.json or subject.home / "wind.json"
        for output in (results, figure):
            claim_file(output, force=self.force)
        rows = evaluate_in_wind(*where, *winds, episodes=self.episodes, seed=seed)
        write_json(results, {"command": command_line, "results": rows})
        write_panels(*where, *winds, figure)
        print_winds(rows, title=f"{self.source}: wind at {self.wind_angle:g} degrees")
        print(f"written: {results}, {figure}")


@dataclass(frozen=True)
class _Subject:
    """A policy, where it acts, and the folder that its files go to by default."""

    policy: Policy
    field: Field
    settings: Mapping[str, Any]
    home: Path


def print_evaluations(
    summaries: Sequence[Mapping[str, Any]], title: str, optimum: float | None = None
) -> None:
    """Print evaluations (as ``Evaluation.summary()`` has them) as a table, one a row.

    Args:
        summaries: the rows.
        title: above the table.
        optimum: the proved best return, from which the gap is measured; ``None`` for no gap.
    """
    from rich import box
    from rich.table import Table

    from baselines.console import console

    table = Table(title=title, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    headings = ["actions", "episodes", "return", "min", "max", "success", "makespan"]
    if optimum is not None:
        table.caption = f"gap: to the proved optimum, {optimum:,.0f}"
        headings.append("gap")
    for heading in headings:
        table.add_column(heading, justify="left" if heading == "actions" else "right")
    for summary in summaries:
        makespan = summary["makespan"]
        gap = optimality_gap(summary["return_mean"], optimum)
        table.add_row(
            "mean" if summary["deterministic"] else "sampled",
            str(summary["episodes"]),
            *(f"{summary[f'return_{name}']:,.0f}" for name in ("mean", "min", "max")),
            f"{summary['success_rate']:.1%}",
            "-" if makespan is None else f"{makespan:.1f}",
            *([] if gap is None else [f"{gap:.2%}"]),
        )
    console().print(table)


def print_winds(rows: Sequence[Mapping[str, Any]], title: str) -> None:
    """Print what ``evaluate_in_wind`` returns as a table, one entry a row."""
    from rich.table import Table

    from baselines.console import console

    table = Table(title=title, caption="intervals: 95 % over the episodes")
    for heading in ("wind", "actions", "success", "return", "makespan"):
        table.add_column(heading, justify="left" if heading == "actions" else "right")
    for row in rows:
        table.add_row(
            f"{row['wind_speed']:g}",
            "mean" if row["deterministic"] else "sampled",
            _interval(row["success_interval"], "{:.0%}"),
            _interval(row["return_interval"], "{:,.0f}"),
            _interval(row["makespan_interval"], "{:.1f}"),
        )
    console().print(table)


def _interval(interval: Mapping[str, float | None] | None, form: str) -> str:
    """A mean with its interval below; a dash for none."""
    if interval is None:
        return "-"
    mean, low, high = (interval[name] for name in ("mean", "low", "high"))
    shown = form.format(mean)
    return shown if low is None else f"{shown}\n{form.format(low)} .. {form.format(high)}"
