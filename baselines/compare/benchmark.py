"""A policy on the frozen fields, by the protocol that is the same for all (docs/benchmark.md)."""

from __future__ import annotations

import json
import time
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from baselines.compare.page import episodes_html, folded_html, report_page, tables_html
from baselines.compare.summary import interquartile_mean
from baselines.compare.text_table import TextTable
from baselines.evaluation.evaluate import Evaluation, evaluate, is_one_episode
from baselines.evaluation.intervals import mean_interval, mean_of_known
from baselines.policies.classical import NoPlanError
from baselines.policies.load import Source
from baselines.policies.policy import Policy, Wrapped
from baselines.policies.shielded import Shielded, behind
from baselines.runs.files import RunError, differences, read_json, versions, write_json
from mbn_marl.config import Checked, Condition, NavigationConfig, make_config
from mbn_marl.engine import BatchEngine
from mbn_marl.episode import Episode, load_episode, save_episode
from mbn_marl.errors import ConfigError, EpisodeError, FieldError, ProblemsError, collecting
from mbn_marl.field import Instance, load_split, splits
from mbn_marl.planning import UnsolvableError
from mbn_marl.version import __version__

RESULT, PAGE, EPISODES = "result.json", "page.html", "episodes"
CHOSEN = ("median", "worst")
T_MAX = NavigationConfig().max_steps
MISFITS = (ConfigError, NoPlanError, UnsolvableError)
FORCE_HINT = "use --force to move the folder aside and start again"
WAYS = ("mean", "sampled")
METRICS: Mapping[str, tuple[str, str]] = {
    "success_rate": ("success", "{:.1%}"),
    "clean_rate": ("clean", "{:.1%}"),
    "collision_rate": ("collisions", "{:.1%}"),
    "wall_hits": ("wall hits", "{:.2f}"),
    "steps": ("steps", "{:.1f}"),
    "makespan": ("makespan", "{:.1f}"),
    "makespan_with_failures": ("makespan,\nfailed: T_max", "{:.1f}"),
    "gap": ("gap", "{:.1%}"),
    "gap_to_best_known": ("gap to\nbest known", "{:.1%}"),
    "gap_with_failures": ("gap,\nfailed: T_max", "{:.1%}"),
}
"""The numbers of an instance and a way of acting, see docs/benchmark.md: heading and form."""
TIMES = {"decision_ms": ("ms a\ndecision", "{:.2f}"), "begin_s": ("s to\nbegin", "{:.2f}")}
"""Processor time of a decision of the team, and of what comes before the first one."""
COLUMNS = {**METRICS, **TIMES}
CAPTION = (
    "Intervals: 95 % over the instances. Gap: makespan over the proved bound, of successes. With "
    "failed: T_max, failures count as 1000 steps. Times: of the processor, with mean actions."
)


class EpisodeCounts(Checked):
    mean: int  # with mean actions, where they are all the same
    mean_if_random: int  # with mean actions, where they are not
    sampled: int


class Protocol(Checked):
    """The rules that all policies are measured by."""

    version: int  # results of different versions are not to be compared
    splits: int  # the version of the frozen fields
    tiers: tuple[str, ...]  # of a whole benchmark
    episodes: EpisodeCounts  # of an instance
    seed: int  # of an instance: this, 1000 for each tier before its own, and its number
    settings: tuple[str, ...]  # those that a policy may choose


class SettingsError(ConfigError):
    """A policy wants an environment in which the task is another."""


class Timed(Wrapped):
    """A policy whose decisions are timed: ``seconds`` of the processors, how many ``decisions``."""

    def __init__(self, policy: Policy) -> None:
        super().__init__(policy)
        self.seconds, self.decisions = 0.0, 0

    def fit(self, engine: BatchEngine) -> Timed:
        self.policy = self.policy.fit(engine)
        return self

    def act_in(self, world: Any, observations: Any, *, deterministic: bool = True) -> Any:
        began = time.process_time()
        actions = self.policy.act_in(world, observations, deterministic=deterministic)
        self.seconds += time.process_time() - began
        self.decisions += len(actions)
        return actions


def load_protocol() -> Protocol:
    path = splits.FOLDER / "protocol.json"
    protocol = Protocol(**json.loads(path.read_text(encoding="utf-8")))
    if protocol.splits != splits.VERSION:
        raise ConfigError(str(path), [f"splits: {protocol.splits}; needed: {splits.VERSION}"])
    return protocol


def load_tiers(split: str, tiers: Sequence[str]) -> dict[str, tuple[Instance, ...]]:
    problems: list[str] = []
    loaded = {}
    for tier in tiers:
        with collecting(problems):
            loaded[tier] = load_split(split, tier)
    if problems:
        raise FieldError(f"split {split}", problems)
    return loaded


def run_benchmark(
    source: str,
    split: str,
    tiers: Mapping[str, Sequence[Instance]],
    out: Path,
    *,
    command: str,
    shield: bool = False,
    resume: bool = False,
    advance: Callable[[int], object] = lambda count: None,
) -> dict[str, Any]:
    """Measure a policy, named as for :func:`baselines.load_policy`; write the result of each tier.

    With ``resume`` the tiers in ``out`` are kept; ``advance`` receives how many instances are done.

    Returns:
        The content of ``result.json``, as JSON values.

    Raises:
        ConfigError: the policy fits no tier, or its settings change the task (SettingsError).
        RunError: there is no such policy, it failed, or ``out`` has a result of other settings.
    """
    protocol, path = load_protocol(), out / RESULT
    asked = {"protocol": protocol.version, "splits": protocol.splits, "policy": source}
    asked |= {"shield": shield, "split": split, "asked": [*tiers]}
    record: dict[str, Any] = {**asked, "command": command, "versions": versions(), "tiers": {}}
    if resume and path.exists():
        record = _resumed(path, record, asked)
    loaded = Source(source)
    if loaded.run is not None:  # with settings that are the same in all fields
        check_settings(loaded.make(condition="calm").settings, "calm", protocol)
    done = record["tiers"]
    for tier, instances in tiers.items():
        if tier in done:
            advance(len(instances))
            continue
        done[tier], episodes = _run_tier(loaded, shield, tier, instances, protocol, advance)
        if all(one["misfit"] for one in done.values()):
            continue  # nothing is measured yet
        for name, episode in episodes.items():
            save_episode(episode, out / EPISODES / f"{tier}-{name}.json")
        write_json(path, record)
    misfits = [f"{tier}: {one['misfit']}" for tier, one in done.items() if one["misfit"]]
    if len(misfits) == len(done):
        raise ConfigError(source, misfits)
    rows = [row for one in done.values() for row in one["instances"]]
    whole = set(done) == set(protocol.tiers) and not misfits
    record["all"] = {"instances": len(rows), **summarise(rows)} if whole else None
    write_json(path, record)
    return record


def _resumed(path: Path, new: Mapping[str, Any], asked: Mapping[str, Any]) -> dict[str, Any]:
    try:
        record: dict[str, Any] = read_json(path)
        ours, theirs = (one["versions"]["packages"]["mbn-marl"] for one in (new, record))
        parts = {"misfit", "instances"}
        damaged = [tier for tier, one in record["tiers"].items() if not parts <= one.keys()]
    except RunError as error:
        raise RunError(f"{error}; {FORCE_HINT}") from None
    except (KeyError, TypeError, AttributeError):
        raise RunError(f"{path} is no result of mbn benchmark; {FORCE_HINT}") from None
    problems = [f"{tier}: is damaged" for tier in damaged]
    problems += differences({**record, "mbn-marl": theirs}, {**asked, "mbn-marl": ours})
    if problems:
        raise RunError(f"{path}: {'; '.join(problems)}; {FORCE_HINT}")
    return record


def _run_tier(
    source: Source,
    shield: bool,
    tier: str,
    instances: Sequence[Instance],
    protocol: Protocol,
    advance: Callable[[int], object],
) -> tuple[dict[str, Any], dict[str, Episode]]:
    """Return what is found in a tier, and the first episodes of the chosen instances."""
    seed = protocol.seed + 1000 * splits.NAMES.index(tier)
    rows, episodes = [], []
    for k, one in enumerate(instances):
        try:
            row, episode = _run_instance(source, shield, one, seed + k, protocol)
        except (SettingsError, RunError, ImportError):
            raise
        except MISFITS as error:
            why = "; ".join(error.problems) if isinstance(error, ProblemsError) else str(error)
            advance(len(instances) - k)
            return {"misfit": f"{one.field.name}: {why}", "instances": []}, {}
        except Exception as error:
            what = "".join(traceback.format_exception_only(error)).strip()
            last = traceback.extract_tb(error.__traceback__)[-1]
            place = f"{tier}, {one.field.name}: {what} ({last.filename}, line {last.lineno})"
            kept = "--resume keeps the tiers that are done"
            raise RunError(f"{source.name} failed in {place}; {kept}") from error
        rows.append(row)
        episodes.append(episode)
        advance(1)
    costs = [
        row["mean"]["makespan_with_failures"] / (row["makespan_lower_bound"] or 1) for row in rows
    ]
    order = np.argsort(costs, kind="stable")
    chosen = dict(zip(CHOSEN, (int(order[len(order) // 2]), int(order[-1])), strict=True))
    shown = {}
    for name, k in chosen.items():
        condition = instances[k].condition
        where = rows[k]["field"] + ("" if condition == "calm" else f", {condition}")
        shown[name] = replace(episodes[k], source=f"{name}: {where}")
    return {"misfit": None, **chosen, **summarise(rows), "instances": rows}, shown


def _run_instance(
    source: Source, shield: bool, one: Instance, seed: int, protocol: Protocol
) -> tuple[dict[str, Any], Episode]:
    began = time.process_time()
    loaded = source.make(one.field, seed=seed, condition=one.condition)
    begin = time.process_time() - began
    check_settings(loaded.settings, one.condition, protocol)
    team, fixed = len(one.field.starts), make_config(loaded.settings).n_robots
    if fixed not in (None, team):
        raise ConfigError("policy", [f"n_robots: {fixed}; the field has {team}"])
    policy = Shielded(loaded.policy) if shield else loaded.policy
    counts = protocol.episodes
    timed, where = Timed(policy), (one.field, loaded.settings)
    same = is_one_episode(policy, loaded.settings, deterministic=True)
    count = counts.mean if same else counts.mean_if_random
    mean = evaluate(timed, *where, episodes=count, deterministic=True, seed=seed, record=[0])
    sampled = None
    if policy.draws(deterministic=False):
        sampled = evaluate(policy, *where, episodes=counts.sampled, seed=seed)
    row = {
        **{"field": one.field.name, "condition": one.condition},
        **{"makespan_lower_bound": one.makespan_lower_bound, "best_known": one.best_known},
        "mean": numbers(mean, one),
        "sampled": None if sampled is None else numbers(sampled, one),
        "times": {"decision_ms": 1e3 * timed.seconds / timed.decisions, "begin_s": begin},
    }
    return row, mean.recorded[0]


def check_settings(settings: Mapping[str, Any], condition: Condition, protocol: Protocol) -> None:
    """Raise a SettingsError that lists the settings of a policy, without its size of the team."""
    ours, theirs = make_config({"condition": condition}), make_config(settings)
    problems = [
        f"{name}: {getattr(theirs, name)!r}; allowed: {getattr(ours, name)!r}"
        for name in NavigationConfig.model_fields
        if name not in ("n_robots", *protocol.settings)
        and getattr(ours, name) != getattr(theirs, name)
    ]
    if problems:
        raise SettingsError("settings of the policy, which change the task", problems)


def numbers(found: Evaluation, one: Instance) -> dict[str, float | None]:
    def gap(steps: float | None, least: int | None) -> float | None:
        return None if steps is None or least is None else steps / least - 1.0

    ends = [*zip(found.steps, found.successes, strict=True)]
    makespan = mean_of_known(found.makespans)
    capped = float(np.mean([steps if success else T_MAX for steps, success in ends]))
    clean = [ok and not hits for ok, hits in zip(found.successes, found.wall_hits, strict=True)]
    return {
        "success_rate": float(np.mean(found.successes)),
        "clean_rate": float(np.mean(clean)),
        "collision_rate": float(np.mean(found.collisions)),
        "wall_hits": float(np.mean(found.wall_hits)),
        "steps": float(np.mean(found.steps)),
        "makespan": makespan,
        "makespan_with_failures": capped,
        "gap": gap(makespan, one.makespan_lower_bound),
        "gap_to_best_known": gap(makespan, one.best_known),
        "gap_with_failures": gap(capped, one.makespan_lower_bound),
    }


def summarise(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for way, names in ((WAYS[0], METRICS), (WAYS[1], METRICS), ("times", TIMES)):
        known = [row[way] for row in rows if row[way] is not None]
        each = {name: statistics([row[name] for row in known]) for name in names}
        found[way] = each if known else None
    return found


def statistics(values: Sequence[float | None]) -> dict[str, Any] | None:
    """Return mean and interquartile mean of what is known, with bootstrapped 95 % intervals."""
    known = [value for value in values if value is not None]
    if not known:
        return None
    mean, low, high = mean_interval(known)
    same = len(set(known)) == 1
    iqm, iqm_low, iqm_high = (
        (mean, low, high) if same else interquartile_mean(np.array([known], float))
    )
    return {
        **{"instances": len(known), "mean": mean, "low": low, "high": high},
        **{"iqm": iqm, "iqm_low": iqm_low, "iqm_high": iqm_high},
    }


def cells(found: Mapping[str, Any], way: str, columns: Iterable[str] = COLUMNS) -> tuple[str, ...]:
    """Return a tier's means with their intervals below; dashes for what is not known."""
    known = {**(found.get(way) or {}), **(found.get("times") or {})}

    def cell(name: str) -> str:
        if (one := known.get(name)) is None:
            return "-"
        form, low, high = COLUMNS[name][1], one["low"], one["high"]
        ends = "" if low in (None, high) else f"\n{form} .. {form}".format(low, high)
        return form.format(one["mean"]) + ends

    return tuple(map(cell, columns))


def result_tables(record: Mapping[str, Any]) -> dict[str, TextTable]:
    """Return the tables of a result by the way of acting in words."""
    misfits = {tier: one["misfit"] for tier, one in record["tiers"].items() if one["misfit"]}
    reasons = [f"{tier} does not fit: {reason}" for tier, reason in misfits.items()]
    tables = {}
    for way in WAYS:
        found = [(tier, one) for tier, one in record["tiers"].items() if one.get(way)]
        if not found:
            continue
        lines = [(tier, str(len(one["instances"])), one) for tier, one in found]
        if (every := record["all"]) is not None:
            lines.append(("all", str(every["instances"]), every))
        lines += [(tier, "-", {}) for tier in misfits]
        tables[f"{way} actions, means"] = TextTable(
            "\n".join([CAPTION, *reasons]),
            ("tier", "fields", *(heading for heading, _ in COLUMNS.values())),
            [(tier, count, *cells(one, way)) for tier, count, one in lines],
        )
    return tables


def result_page(record: Mapping[str, Any], out: Path) -> str:
    sections = {"All tiers": tables_html(result_tables(record))}
    sections |= {tier: _tier_parts(tier, one, out) for tier, one in record["tiers"].items()}
    sections["Command"] = folded_html({"This benchmark": record["command"]})
    policy = f"{record['policy']}{behind(record['shield'])} on the split {record['split']}"
    by = f"protocol {record['protocol']}. Made by mbn_marl {__version__}."
    return report_page("Benchmark", f"{policy}, {by}", sections)


def _tier_parts(tier: str, found: Mapping[str, Any], out: Path) -> list[str]:
    if found["misfit"]:
        return folded_html({"Does not fit": found["misfit"]})
    try:
        episodes = [load_episode(out / EPISODES / f"{tier}-{name}.json") for name in CHOSEN]
    except (EpisodeError, OSError) as error:  # of a tier that was done before
        return folded_html({"Not shown": str(error)})
    return episodes_html(tier, episodes)
