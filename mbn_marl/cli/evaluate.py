"""``mbn evaluate``: fresh episodes of a trained policy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

if TYPE_CHECKING:
    from baselines.policies import Policy
    from baselines.runs import RunFolder


@dataclass(frozen=True)
class Evaluate:
    """Evaluate the policy of a run on fresh episodes, with sampled and with mean actions."""

    source: Positional[Annotated[str, arg(metavar="RUN")]]
    """The folder of a run, or zoo:NAME, a policy of `mbn zoo`."""
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

    def run(self, command_line: str) -> None:
        """Evaluate, print the summaries, and write the file if one is asked for."""
        from baselines.evaluate import EVALUATION_SEED
        from baselines.policies import load_policy
        from baselines.zoo.entries import PREFIX, open_run
        from mbn_marl.errors import ConfigError

        if self.episodes < 1:
            raise ConfigError("evaluation", [f"episodes: at least 1, not {self.episodes}"])
        if self.figure is not None and self.wind_speeds is None:
            raise ConfigError("evaluation", ["figure: allowed with --wind-speeds"])
        if self.record is not None and self.wind_speeds is not None:
            raise ConfigError("evaluation", ["record: allowed without --wind-speeds"])
        files = (self.json, self.figure)
        if self.wind_speeds is not None and self.source.startswith(PREFIX) and None in files:
            raise ConfigError("evaluation", ["json, figure: of a zoo policy in wind, name both"])
        run = open_run(self.source)
        seed = EVALUATION_SEED if self.seed is None else self.seed
        if self.wind_speeds is None:
            self._evaluate(run, load_policy(run), seed, command_line)
        else:
            self._evaluate_in_wind(run, load_policy(run), seed, command_line, self.wind_speeds)

    def _evaluate(self, run: RunFolder, policy: Policy, seed: int, command_line: str) -> None:
        """Evaluate as the run was trained."""
        from baselines.evaluate import evaluate_both, record_evaluation
        from baselines.storage import claim_folder, write_json
        from mbn_marl.episode import save_episode

        if self.record is not None:
            claim_folder(self.record)
        results = evaluate_both(
            policy, run.field, run.config["environment"], episodes=self.episodes, seed=seed
        )
        print_evaluations([result.summary() for result in results.values()], title=self.source)
        if self.json is not None:
            episodes = {name: result.to_json() for name, result in results.items()}
            write_json(self.json, {"command": command_line, **episodes})
        if self.record is None:
            return
        recorded = record_evaluation(
            policy,
            run.field,
            run.config["environment"],
            episodes=self.episodes,
            seed=seed,
            source=self.source,
        )
        for name, episode in recorded.items():
            save_episode(episode, self.record / f"{name}.json")
        print(f"recorded: {', '.join(recorded)} in {self.record}")

    def _evaluate_in_wind(
        self, run: RunFolder, policy: Policy, seed: int, command_line: str, speeds: str
    ) -> None:
        """Evaluate at several wind speeds; write the episodes and the picture."""
        from baselines.storage import write_json
        from baselines.wind import evaluate_in_wind, parse_speeds, write_panels
        from mbn_marl.render.figures import check_name

        winds = parse_speeds(speeds), self.wind_angle
        where = policy, run.field, run.config["environment"]
        figure = check_name(self.figure or run.path / "wind.png")
        results = self.json or run.path / "wind.json"
        rows = evaluate_in_wind(*where, *winds, episodes=self.episodes, seed=seed)
        write_json(results, {"command": command_line, "results": rows})
        write_panels(*where, *winds, figure)
        print_winds(rows, title=f"{self.source}: wind at {self.wind_angle:g} degrees")
        print(f"written: {results}, {figure}")


def print_evaluations(summaries: Sequence[Mapping[str, Any]], title: str) -> None:
    """Print evaluations (as ``Evaluation.summary()`` has them) as a table, one a row."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for heading in ("actions", "episodes", "return", "min", "max", "success", "makespan"):
        table.add_column(heading, justify="left" if heading == "actions" else "right")
    for summary in summaries:
        makespan = summary["makespan"]
        table.add_row(
            "mean" if summary["deterministic"] else "sampled",
            str(summary["episodes"]),
            *(f"{summary[f'return_{name}']:,.0f}" for name in ("mean", "min", "max")),
            f"{summary['success_rate']:.1%}",
            "-" if makespan is None else f"{makespan:.1f}",
        )
    Console().print(table)


def print_winds(rows: Sequence[Mapping[str, Any]], title: str) -> None:
    """Print what ``evaluate_in_wind`` returns as a table, one entry a row."""
    from rich.console import Console
    from rich.table import Table

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
    Console().print(table)


def _interval(interval: Mapping[str, float | None] | None, form: str) -> str:
    """A mean with its interval below; a dash for none."""
    if interval is None:
        return "-"
    mean, low, high = (interval[name] for name in ("mean", "low", "high"))
    shown = form.format(mean)
    return shown if low is None else f"{shown}\n{form.format(low)} .. {form.format(high)}"
