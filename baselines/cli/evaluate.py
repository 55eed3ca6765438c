"""``mbn evaluate``: fresh episodes of a trained policy, or of a classical one."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from baselines.cli.options import check_options
from mbn_marl.config import Condition
from mbn_marl.optimum import optimality_gap

ONE_EPISODE = "deterministic:\none episode"
"""In place of a number of episodes, where all are the same."""


@dataclass(frozen=True)
class Evaluate:
    """Evaluate a policy on fresh episodes, with sampled and with mean actions."""

    source: Positional[Annotated[str, arg(metavar="POLICY")]]
    """The folder of a run; zoo:NAME, a policy of `mbn zoo`; greedy, earliest visit first; planner,
    the best plan, followed in closed loop; replan, which plans again if the world leaves it;
    random; module:callable, your own; or lookahead: before one of them, see docs/benchmark.md."""
    field: str | None = None
    """For policies that have none of their own: a name of `mbn fields`, or a field file."""
    episodes: int = 100
    """How many episodes."""
    seed: int | None = None
    """Of the episodes; by default the seed that every run's final evaluation has."""
    json: Path | None = None
    """Write every episode to this file; with --wind-speeds by default RUN/wind.json."""
    record: Path | None = None
    """A new folder for the best, the median and the worst episode with sampled actions, as files
    for `mbn replay`."""
    condition: Condition | None = None
    """A named condition, whose weather and failures replace the run's; by default as it was
    trained."""
    shield: bool = False
    """Let robots do only what they could brake after, whatever the policy wants."""
    wind_speeds: str | None = None
    """Wind speeds to evaluate at, such as 0,0.1,..,0.5 (units/step per step)."""
    wind_angle: float = 30.0
    """The direction of that wind, degrees from +x."""
    figure: Path | None = None
    """With --wind-speeds: the picture of an episode at each, by default RUN/wind.png."""
    force: bool = False
    """If an output exists, move it aside (to OUT.1, OUT.2, ...)."""

    def run(self, command_line: str) -> None:
        """Evaluate, print the summaries, and write the files that are asked for."""
        from baselines.zoo.entries import PREFIX
        from baselines.zoo.sources import takes_field

        in_wind, asks = self.wind_speeds is not None, takes_field(self.source)
        field = f"{self.source} has its own"
        if asks:
            field = f"needed, for example: mbn evaluate {self.source} --field field_03"
        homeless = asks or self.source.startswith(PREFIX)
        wrong = {
            f"episodes: at least 1, not {self.episodes}": self.episodes < 1,
            "figure: allowed with --wind-speeds": self.figure is not None and not in_wind,
            "record: allowed without --wind-speeds": self.record is not None and in_wind,
            "json, figure: of a policy without a run folder in wind, name both": in_wind
            and homeless
            and None in (self.json, self.figure),
            "condition: allowed without --wind-speeds": self.condition is not None and in_wind,
            f"field: {field}": asks != (self.field is not None),
        }
        check_options("evaluation", wrong)
        how, home = self._subject()
        if self.wind_speeds is None:
            self._evaluate(how, command_line)
        else:
            self._evaluate_in_wind(how, command_line, home, self.wind_speeds)

    def _subject(self) -> tuple[dict[str, Any], Path]:
        """Return the arguments of `evaluate`, and the folder that files go to by default."""
        from baselines.evaluation.evaluate import EVALUATION_SEED
        from baselines.evaluation.shielded import Shielded
        from baselines.zoo.entries import open_run
        from baselines.zoo.sources import find_policy

        seed = EVALUATION_SEED if self.seed is None else self.seed
        loaded = find_policy(self.source, self.field, seed=seed, condition=self.condition)
        policy = Shielded(loaded) if self.shield else loaded.policy
        subject = {
            **{"policy": policy, "field": loaded.field, "settings": loaded.settings},
            **{"episodes": self.episodes, "seed": seed},
        }
        if self.field is not None:
            return subject, Path()
        run = open_run(self.source)
        if run.unfinished is not None:
            print(run.unfinished)
        return subject, run.path

    def _evaluate(self, how: dict[str, Any], command_line: str) -> None:
        """Evaluate as the policy was trained, or under the condition."""
        from baselines.evaluation.evaluate import evaluate_both, is_one_episode, record_evaluation
        from baselines.evaluation.shielded import behind
        from baselines.runs.files import claim_folder, write_json
        from mbn_marl.config import make_config
        from mbn_marl.episode import save_episode
        from mbn_marl.files import check_free, claim_file
        from mbn_marl.optimum import optimal_return

        if self.json is not None:
            check_free(self.json, force=self.force)
        if self.record is not None:
            claim_folder(self.record, force=self.force)
        results = evaluate_both(**how)
        optimum = optimal_return(how["field"], make_config(how["settings"]))
        one = partial(is_one_episode, how["policy"], how["settings"])
        summaries = {name: result.summary() for name, result in results.items()}
        policy = f"{self.source}{behind(self.shield)}"
        title = policy if self.condition is None else f"{policy}, {self.condition}"
        print_evaluations(summaries.values(), title, optimum, one)
        if self.json is not None:
            gaps = {
                name: optimality_gap(summary["return_mean"], optimum)
                for name, summary in summaries.items()
            }
            heading: dict[str, Any] = {"command": command_line, "condition": self.condition}
            heading |= {"shield": self.shield, "optimum": optimum, "optimality_gap": gaps}
            episodes = {name: result.to_json() for name, result in results.items()}
            write_json(claim_file(self.json, force=self.force), {**heading, **episodes})
        if self.record is not None:
            source = title if self.field else f"{title}, sampled actions"
            recorded = record_evaluation(**how, source=source)
            for name, episode in recorded.items():
                named = replace(episode, source=f"{episode.source}, {name}")
                save_episode(named, self.record / f"{name}.json")
            print(f"recorded: {', '.join(recorded)} in {self.record}")

    def _evaluate_in_wind(
        self, how: dict[str, Any], command_line: str, home: Path, speeds: str
    ) -> None:
        """Evaluate at several wind speeds; write the episodes and the picture."""
        from baselines.evaluation.shielded import behind
        from baselines.evaluation.wind import evaluate_in_wind, parse_speeds, write_panels
        from baselines.runs.files import write_json
        from mbn_marl.files import check_free, claim_file
        from mbn_marl.render.figures import check_name

        winds: dict[str, Any] = {"speeds": parse_speeds(speeds), "angle": self.wind_angle}
        figure = check_name(self.figure or home / "wind.png")
        results = self.json or home / "wind.json"
        for output in (results, figure):
            check_free(output, force=self.force)
        rows, episodes = evaluate_in_wind(**how, **winds)
        written = {"command": command_line, "results": rows}
        write_json(claim_file(results, force=self.force), written)
        write_panels(episodes, claim_file(figure, force=self.force))
        policy = f"{self.source}{behind(self.shield)}"
        print_winds(rows, title=f"{policy}: wind at {self.wind_angle:g} degrees")
        print(f"written: {results}, {figure}")


def print_evaluations(
    summaries: Iterable[Mapping[str, Any]],
    title: str,
    optimum: float | None = None,
    one: Callable[..., bool] = lambda *, deterministic: False,
) -> None:
    """Print evaluations (as ``Evaluation.summary()`` has them) as a table, one a row.

    ``optimum`` is the proved best return, if there is one; ``one(deterministic=...)`` says whether
    all episodes of a row are the same.
    """
    from baselines.compare.text_table import TextTable

    caption = "" if optimum is None else f"gap: to the proved optimum, {optimum:,.0f}"
    headings = ("actions", "episodes", "return", "min", "max", "success", "makespan", "gap")
    lines = []
    for summary in summaries:
        makespan, deterministic = summary["makespan"], summary["deterministic"]
        gap = optimality_gap(summary["return_mean"], optimum)
        lines.append(
            (
                "mean" if deterministic else "sampled",
                ONE_EPISODE if one(deterministic=deterministic) else str(summary["episodes"]),
                *(f"{summary[f'return_{name}']:,.0f}" for name in ("mean", "min", "max")),
                f"{summary['success_rate']:.1%}",
                "-" if makespan is None else f"{makespan:.1f}",
                *([] if gap is None else [f"{gap:.2%}"]),
            )
        )
    TextTable(caption, headings[: len(lines[0])], tuple(lines)).print(title)


def print_winds(rows: Sequence[Mapping[str, Any]], title: str) -> None:
    """Print what ``evaluate_in_wind`` returns as a table, one entry a row."""
    from baselines.compare.text_table import TextTable

    def shown(row: Mapping[str, Any], name: str, mean: str, form: str) -> str:
        """Return a mean with its interval below, if it has one; a dash for none."""
        interval = row[f"{name}_interval"] or {"low": None, "high": None}
        ends = f"\n{form} .. {form}" if interval["low"] is not None else ""
        whole = f"{form}{ends.format(interval['low'], interval['high'])}"
        return "-" if row[mean] is None else whole.format(row[mean])

    lines = tuple(
        (
            f"{row['wind_speed']:g}",
            "mean" if row["deterministic"] else "sampled",
            str(row["episodes"]) if row["return_interval"] else ONE_EPISODE,
            shown(row, "success", "success_rate", "{:.0%}"),
            shown(row, "return", "return_mean", "{:,.0f}"),
            shown(row, "makespan", "makespan", "{:.1f}"),
        )
        for row in rows
    )
    headings = ("wind", "actions", "episodes", "success", "return", "makespan")
    TextTable("intervals: 95 % over the episodes", headings, lines, words=2).print(title)
