"""A policy on the frozen fields, by the protocol that is the same for all (docs/benchmark.md)."""

import hashlib
import json
import math
import time
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from baselines.compare.page import episodes_html, folded_html, report_page, tables_html
from baselines.compare.text_table import TextTable
from baselines.evaluation.evaluate import Evaluation, evaluate, is_one_episode
from baselines.evaluation.intervals import Interval, mean_interval
from baselines.policies.classical import NoPlanError
from baselines.policies.load import Source
from baselines.policies.policy import Policy, Wrapped
from baselines.policies.shielded import Shielded, behind, information_of
from baselines.runs.files import RunError, differences, read_json, versions, write_json
from mbn_marl.config import Checked, Condition, NavigationConfig, make_config
from mbn_marl.engine import BatchEngine
from mbn_marl.episode import Episode, check_episode, load_episode, save_episode
from mbn_marl.errors import ConfigError, EpisodeError, FieldError, ProblemsError, collecting
from mbn_marl.field import Instance, load_split, splits
from mbn_marl.planning import UnsolvableError
from mbn_marl.version import __version__

RESULT, PAGE, EPISODES = "result.json", "page.html", "episodes"
ALL = "all"
CHOSEN = ("median", "worst")
MISFITS = (ConfigError, NoPlanError, UnsolvableError)
FORCE_HINT = "use --force to move the folder aside and start again"
WAYS = ("mean", "sampled")
METRICS: Mapping[str, tuple[str, str]] = {
    "spl": ("SPL", "{:.1%}"),
    "success_rate": ("success", "{:.1%}"),
    "gap": ("gap", "{:.1%}"),
    "makespan": ("makespan", "{:.1f}"),
    "clean_rate": ("clean", "{:.1%}"),
    "collision_rate": ("collisions", "{:.1%}"),
    "wall_hits": ("wall hits", "{:.2f}"),
}
"""The numbers of an instance and a way of acting, see docs/benchmark.md: heading and form."""
TIMES = {"decision_ms": ("ms a\ndecision", "{:.2f}"), "begin_s": ("s to\nbegin", "{:.2f}")}
"""Processor time of a decision of the team, and of what comes before the first one."""
COLUMNS = {**METRICS, **TIMES}
PRICES = {
    "price of information": ("inf", "bound"),
    "price of decentralisation, 100": ("100", "inf"),
    "price of decentralisation, 0": ("0", "inf"),
}
"""The makespans, at communication radii of 6-search, whose ratios are prices."""
CAPTION = (
    "SPL: proved bound / makespan, failures 0. Gap: makespan / bound - 1, of successes. Intervals: "
    "95 % over the instances. Times: of the processor, with mean actions."
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

    def fit(self, engine: BatchEngine) -> Self:
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
    protocol, path, loaded = load_protocol(), out / RESULT, Source(source)
    asked = {"protocol": protocol.version, "splits": protocol.splits, "policy": source}
    asked |= {"shield": shield, "split": split, "asked": [*tiers]}
    if loaded.run is not None:  # a run that has trained on is another policy
        weights = sorted(loaded.run.policy.glob("*.safetensors"))
        digest = hashlib.sha256(b"".join(path.read_bytes() for path in weights))
        asked["weights"] = digest.hexdigest()
    record: dict[str, Any] = {**asked, "command": command, "versions": versions(), "tiers": {}}
    if resume and path.exists():
        record = _resumed(path, record, asked)
    if loaded.run is not None:  # with settings that are the same in all fields
        for first, *_ in tiers.values():
            settings = loaded.make(condition="calm", **first.settings).settings
            check_settings(settings, "calm", protocol, first.settings)
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
    return record


def _resumed(path: Path, new: Mapping[str, Any], asked: Mapping[str, Any]) -> dict[str, Any]:
    try:
        record: dict[str, Any] = read_json(path)
        ours, theirs = (one["versions"]["packages"]["mbn-marl"] for one in (new, record))
        damaged = [tier for tier, one in record["tiers"].items() if _is_damaged(tier, one)]
    except RunError as error:
        raise RunError(f"{error}; {FORCE_HINT}") from None
    except (KeyError, TypeError, AttributeError):
        raise RunError(f"{path} is no result of mbn benchmark; {FORCE_HINT}") from None
    problems = [f"{tier}: is damaged" for tier in damaged]
    problems += differences({**record, "mbn-marl": theirs}, {**asked, "mbn-marl": ours})
    if problems:
        raise RunError(f"{path}: {'; '.join(problems)}; {FORCE_HINT}")
    return record


def _is_damaged(tier: str, one: Mapping[str, Any]) -> bool:
    try:
        summaries({tier: {name: one[name] for name in ("misfit", "instances")}})
    except (KeyError, TypeError, AttributeError, ValueError):
        return True
    return False


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
    fields = [*dict.fromkeys(one.field.name for one in instances)]  # one seed at all radii
    rows, episodes = [], []
    for k, one in enumerate(instances):
        try:
            number = seed + fields.index(one.field.name)
            row, episode = _run_instance(source, shield, one, number, protocol)
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
    order = sorted(range(len(rows)), key=lambda k: rank(rows[k]["mean"]), reverse=True)
    chosen = dict(zip(CHOSEN, (order[len(order) // 2], order[-1]), strict=True))
    shown = {}
    for name, k in chosen.items():
        condition, radius = instances[k].condition, instances[k].radius
        where = rows[k]["field"] + ("" if condition == "calm" else f", {condition}")
        where += "" if radius is None else f", comm_radius {radius}"
        shown[name] = replace(episodes[k], source=f"{name}: {where}")
    return {"misfit": None, **chosen, "instances": rows}, shown


def _run_instance(
    source: Source, shield: bool, one: Instance, seed: int, protocol: Protocol
) -> tuple[dict[str, Any], Episode]:
    began = time.process_time()
    loaded = source.make(one.field, seed=seed, condition=one.condition, **one.settings)
    begin = time.process_time() - began
    check_settings(loaded.settings, one.condition, protocol, one.settings)
    team, fixed = len(one.field.starts), make_config(loaded.settings).n_robots
    if fixed not in (None, team):
        raise ConfigError("policy", [f"n_robots: {fixed}; the field has {team}"])
    policy = Shielded(loaded.policy) if shield else loaded.policy
    counts = protocol.episodes
    timed, where = Timed(policy), ([one], loaded.settings)
    same = is_one_episode(policy, loaded.settings, deterministic=True)
    count = counts.mean if same else counts.mean_if_random
    mean = evaluate(timed, *where, episodes=count, deterministic=True, seed=seed, record=[0])
    sampled = None
    if policy.draws(deterministic=False) and not policy.draws(deterministic=True):
        sampled = evaluate(policy, *where, episodes=counts.sampled, seed=seed)
    row = {
        **{"field": one.field.name, "condition": one.condition},
        **({} if one.radius is None else {"comm_radius": one.radius}),
        "makespan_lower_bound": one.makespan_lower_bound,
        "information": information_of(policy, loaded.settings, source.run),
        "mean": numbers(mean),
        "sampled": None if sampled is None else numbers(sampled),
        "times": {"decision_ms": 1e3 * timed.seconds / timed.decisions, "begin_s": begin},
    }
    return row, mean.recorded[0]


def check_settings(
    settings: Mapping[str, Any],
    condition: Condition,
    protocol: Protocol,
    fixed: Mapping[str, Any] = {},
) -> None:
    """Raise a SettingsError that lists the settings of a policy, without its size of the team.

    Those that a tier has ``fixed`` are no choice of a policy.
    """
    seen = {"observation": "entities", **fixed} if fixed else {}
    ours, theirs = make_config({"condition": condition, **seen}), make_config(settings)
    if problems := [
        f"{name}: {getattr(theirs, name)!r}; allowed: {getattr(ours, name)!r}"
        for name in NavigationConfig.model_fields
        if name not in ("n_robots", *protocol.settings)
        and getattr(ours, name) != getattr(theirs, name)
    ]:
        raise SettingsError("settings of the policy, which change the task", problems)


def numbers(found: Evaluation) -> dict[str, float | None]:
    clean = [ok and not hits for ok, hits in zip(found.successes, found.wall_hits, strict=True)]
    known = {**found.summary(), "clean_rate": float(np.mean(clean))}
    return {name: known[name] for name in METRICS}


def rank(found: Mapping[str, float | None]) -> tuple[float, ...]:
    """Return what orders rows, highest first: SPL; without a bound success, then makespan."""
    if (spl := found["spl"]) is not None:
        return (spl,)
    return found["success_rate"] or 0.0, -(found["makespan"] or math.inf)


def summarise(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the means over the instances of each way of acting, with 95 % intervals."""
    information = ", ".join(sorted({row["information"] for row in rows}))
    found: dict[str, Any] = {"information": information, "instances": len(rows)}
    for way, names in ((WAYS[0], METRICS), (WAYS[1], METRICS), ("times", TIMES)):
        known = [row[way] for row in rows if row[way] is not None]
        each = {name: [row[name] for row in known if row[name] is not None] for name in names}
        means = {name: mean_interval(values) if values else None for name, values in each.items()}
        found[way] = means if known else None
    return found


def summaries(tiers: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return those of a result's tiers, and of ``all`` of a whole result; none of misfits."""
    rows = {tier: one["instances"] for tier, one in tiers.items() if not one["misfit"]}
    whole = load_protocol().tiers
    if set(rows) >= set(whole):
        rows[ALL] = [row for tier in whole for row in rows[tier]]
    parts: dict[str, list[Any]] = {}
    for tier, own in rows.items():
        for row in own:
            radius = row.get("comm_radius")
            parts.setdefault(tier if radius is None else f"{tier}, {radius}", []).append(row)
    return {tier: summarise(own) for tier, own in parts.items()}


def prices(rows: Iterable[Mapping[str, Any]], way: str = WAYS[0]) -> dict[str, Interval]:
    """Return the prices of information and decentralisation, see docs/benchmark.md, by name.

    Each is a mean ratio of makespans over the fields on which both episodes succeed.
    """
    steps: dict[str, dict[str, float]] = {}
    for row in rows:
        steps.setdefault("bound", {})[row["field"]] = row["makespan_lower_bound"]
        if row[way] and row[way]["makespan"] is not None:
            steps.setdefault(row["comm_radius"], {})[row["field"]] = row[way]["makespan"]
    found = {}
    for name, (over, under) in PRICES.items():
        above, below = (steps.get(one, {}) for one in (over, under))
        if ratios := [above[field] / below[field] for field in above if field in below]:
            found[name] = mean_interval(ratios)
    return found


def cells(found: Mapping[str, Any], way: str, columns: Iterable[str] = COLUMNS) -> tuple[str, ...]:
    """Return a tier's means with their intervals below; dashes for what is not known."""
    known = {**(found.get(way) or {}), **(found.get("times") or {})}

    def cell(name: str) -> str:
        if (one := known.get(name)) is None:
            return "-"
        form = COLUMNS[name][1]
        ends = "" if one.low in (None, one.high) else f"\n{form} .. {form}".format(*one[1:])
        return form.format(one.mean) + ends

    return tuple(map(cell, columns))


def result_tables(record: Mapping[str, Any]) -> dict[str, TextTable]:
    """Return the tables of a result by the way of acting in words."""
    found = summaries(record["tiers"])
    misfits = {tier: one["misfit"] for tier, one in record["tiers"].items() if one["misfit"]}
    notes = [CAPTION, *(f"{tier} does not fit: {why}" for tier, why in misfits.items())]
    headings = ("tier", "information", "fields", *(heading for heading, _ in COLUMNS.values()))
    tables = {}
    for way in WAYS:
        if not any(one[way] for one in found.values()):
            continue
        lines = [
            (tier, one["information"], str(one["instances"]), *cells(one, way))
            for tier, one in found.items()
        ]
        lines += [(tier, "-", "-", *cells({}, way)) for tier in misfits]
        tables[f"{way} actions, means"] = TextTable("\n".join(notes), headings, lines, words=2)
    searched = record["tiers"].get(splits.SEARCH, {"instances": []})["instances"]
    for way in WAYS:
        lines = [
            (name, *("-" if end is None else f"{end:.2f}" for end in price))
            for name, price in prices(searched, way).items()
        ]
        if not lines:
            continue
        headings = ("ratio of makespans", "mean", "low", "high")
        caption = "Of the fields on which both succeed; intervals: 95 %."
        tables[f"{way} actions, prices"] = TextTable(caption, headings, lines, words=1)
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
        paths = [out / EPISODES / f"{tier}-{name}.json" for name in CHOSEN]
        episodes = [check_episode(load_episode(path), str(path)) for path in paths]
    except (EpisodeError, OSError) as error:  # of a tier that was done before
        return folded_html({"Not shown": str(error)})
    return episodes_html(tier, episodes)
