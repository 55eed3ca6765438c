"""A policy on the frozen fields, by the protocol that is the same for all (docs/benchmark.md)."""

from __future__ import annotations

import json
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from baselines.compare.benchmark_statistics import summarise, tier_problems
from baselines.evaluation.evaluate import Evaluation, evaluate, is_one_episode
from baselines.evaluation.intervals import mean_of_known
from baselines.policies.classical import NoPlanError
from baselines.policies.load import Source
from baselines.policies.policy import Policy, Wrapped
from baselines.policies.shielded import Shielded
from baselines.runs.files import RunError, differences, read_json, write_json
from baselines.runs.provenance import versions
from mbn_marl.checked import Checked
from mbn_marl.config import Condition, NavigationConfig, make_config
from mbn_marl.engine import BatchEngine
from mbn_marl.episode import Episode, save_episode
from mbn_marl.errors import ConfigError, DamageError, FieldError, ProblemsError, collecting
from mbn_marl.field import Field, Instance, load_split, splits
from mbn_marl.planning import UnsolvableError

RESULT = "result.json"
EPISODES = "episodes"
"""The folder of the episodes of the median and the worst instance of each tier."""
CHOSEN = ("median", "worst")
T_MAX = NavigationConfig().max_steps
MISFITS = (ConfigError, NoPlanError, UnsolvableError)
"""The errors of a policy that does not fit a field."""
FORCE_HINT = "use --force to move the folder aside and start again"


class EpisodeCounts(Checked):
    """How many episodes an instance has.

    Attributes:
        mean: with mean actions, where they are all the same.
        mean_if_random: with mean actions, where they are not.
        sampled: with sampled actions.
    """

    mean: int
    mean_if_random: int
    sampled: int


class Protocol(Checked):
    """The rules that all policies are measured by.

    Attributes:
        version: of the rules; another one gives results that are not to be compared.
        splits: the version of the frozen fields.
        tiers: what a whole benchmark has.
        episodes: how many an instance has.
        seed: the seed of an instance is this, 1000 for each tier before its own, and its number.
        settings: those that a policy may choose; all others are the paper's, or the condition's.
    """

    version: int
    splits: int
    tiers: tuple[str, ...]
    episodes: EpisodeCounts
    seed: int
    settings: tuple[str, ...]


class SettingsError(ConfigError):
    """A policy wants an environment in which the task is another."""


class Timed(Wrapped):
    """A policy whose decisions are timed.

    Attributes:
        seconds: of the processors, for all decisions.
        decisions: how many; those for several worlds at once count as several.
    """

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
    """Return the protocol that is installed."""
    path = splits.FOLDER / "protocol.json"
    protocol = Protocol(**json.loads(path.read_text(encoding="utf-8")))
    if protocol.splits != splits.VERSION:
        raise ConfigError(str(path), [f"splits: {protocol.splits}; needed: {splits.VERSION}"])
    return protocol


def load_tiers(split: str, tiers: Sequence[str]) -> dict[str, tuple[Instance, ...]]:
    """Return the instances of each tier.

    Raises:
        FieldError: listing what :func:`mbn_marl.field.load_split` says of each.
    """
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
    """Measure a policy on all instances; write the result after each tier.

    Args:
        source: of the policy, as for :func:`baselines.load_policy`.
        split: the name of the split.
        tiers: the instances of each tier.
        out: the folder to write.
        command: what was typed.
        shield: whether the policy acts behind the shield (:class:`Shielded`).
        resume: keep the tiers that are in ``out``.
        advance: called with the number of instances that are newly done.

    Returns:
        The content of ``result.json``, as JSON values.

    Raises:
        SettingsError: the policy's settings change the task.
        ConfigError: the policy fits no tier.
        RunError: there is no such policy, or it failed; or what is in ``out`` is damaged, or of
            another command or version.
    """
    protocol, path = load_protocol(), out / RESULT
    asked = {"protocol": protocol.version, "splits": protocol.splits, "policy": source}
    asked |= {"shield": shield, "split": split, "asked": [*tiers]}
    record: dict[str, Any] = {**asked, "command": command, "versions": versions(), "tiers": {}}
    if resume and path.exists():
        record = _resumed(path, record, asked, tiers)
    loaded = Source(source)
    if loaded.run is not None:  # with settings that are the same in all fields
        check_settings(loaded.make(condition="calm").settings, "calm", protocol)
    for tier, instances in tiers.items():
        if tier in record["tiers"]:
            advance(len(instances))
            continue
        measured = _run_tier(loaded, shield, tier, instances, protocol, advance)
        record["tiers"][tier], episodes = measured
        if all(one["misfit"] for one in record["tiers"].values()):
            continue  # nothing is measured yet
        for name, episode in episodes.items():
            save_episode(episode, out / EPISODES / f"{tier}-{name}.json")
        write_json(path, record)
    found = record["tiers"].values()
    if all(one["misfit"] for one in found):
        problems = [f"{tier}: {one['misfit']}" for tier, one in record["tiers"].items()]
        raise ConfigError(source, problems)
    whole = set(record["tiers"]) == set(protocol.tiers) and not any(one["misfit"] for one in found)
    rows = [row for one in found for row in one["instances"]]
    record["all"] = {"instances": len(rows), **summarise(rows)} if whole else None
    write_json(path, record)
    return record


def _resumed(
    path: Path,
    new: Mapping[str, Any],
    asked: Mapping[str, Any],
    tiers: Mapping[str, Sequence[Instance]],
) -> dict[str, Any]:
    """Return the result to go on with; a RunError says why that is not possible."""
    try:
        record = read_json(path)
    except RunError as error:
        raise RunError(f"{error}; {FORCE_HINT}") from None
    ours = new["versions"]["packages"]["mbn-marl"]
    try:
        theirs, done = record["versions"]["packages"]["mbn-marl"], record["tiers"]
        problems = [] if isinstance(record["command"], str) else ["command: missing"]
        both = done.keys() & tiers.keys()
    except (KeyError, TypeError, AttributeError):
        raise RunError(f"{path} is no result of mbn benchmark; {FORCE_HINT}") from None
    problems += differences({**record, "mbn-marl": theirs}, {**asked, "mbn-marl": ours})
    for tier in sorted(both):
        problems += [f"{tier}: {problem}" for problem in tier_problems(done[tier], tiers[tier])]
    if problems:
        raise RunError(f"{path}: {'; '.join(problems)}; {FORCE_HINT}")
    return dict(record)


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
        except (SettingsError, RunError, DamageError, ImportError):
            raise
        except MISFITS as error:
            why = "; ".join(error.problems) if isinstance(error, ProblemsError) else str(error)
            advance(len(instances) - k)
            return {"misfit": f"{one.field.name}: {why}", "instances": []}, {}
        except Exception as error:
            what = "".join(traceback.format_exception_only(error)).strip()
            last = traceback.extract_tb(error.__traceback__)[-1]
            kept = "--resume keeps the tiers that are done"
            raise RunError(
                f"{source.name} failed in {tier}, {one.field.name}: {what} "
                f"({last.filename}, line {last.lineno}); {kept}"
            ) from error
        rows.append(row)
        episodes.append(episode)
        advance(1)
    costs = [
        row["mean"]["makespan_with_failures"] / (one.makespan_lower_bound or 1)
        for row, one in zip(rows, instances, strict=True)
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
    """Return the numbers of an instance, and its first episode with mean actions."""
    began = time.process_time()
    loaded = source.make(one.field, seed=seed, condition=one.condition)
    begin = time.process_time() - began
    check_settings(loaded.settings, one.condition, protocol)
    _check_team(loaded.settings, one.field)
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
    """Check that the settings of a policy leave the task as it is, but for the size of the team.

    Raises:
        SettingsError: listing those that do not.
    """
    ours, theirs = make_config({"condition": condition}), make_config(settings)
    problems = [
        f"{name}: {getattr(theirs, name)!r}; allowed: {getattr(ours, name)!r}"
        for name in NavigationConfig.model_fields
        if name not in ("n_robots", *protocol.settings)
        and getattr(ours, name) != getattr(theirs, name)
    ]
    if problems:
        raise SettingsError("settings of the policy, which change the task", problems)


def _check_team(settings: Mapping[str, Any], field: Field) -> None:
    """Raise a ConfigError where settings fix another number of robots than a field has."""
    team, fixed = len(field.starts), make_config(settings).n_robots
    if fixed not in (None, team):
        raise ConfigError("policy", [f"n_robots: {fixed}; the field has {team}"])


def numbers(found: Evaluation, one: Instance) -> dict[str, float | None]:
    """Return the :data:`~.benchmark_statistics.METRICS` of the episodes of an instance."""
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
        "gap": _gap(makespan, one.makespan_lower_bound),
        "gap_to_best_known": _gap(makespan, one.best_known),
        "gap_with_failures": _gap(capped, one.makespan_lower_bound),
    }


def _gap(steps: float | None, least: int | None) -> float | None:
    return None if steps is None or least is None else steps / least - 1.0
