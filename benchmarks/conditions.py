"""The zoo's policies and the classical ones under every named condition."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, get_args

import numpy as np

from baselines import load_policy
from baselines.classical.controller import CLASSICAL
from baselines.compare.text_table import TextTable
from baselines.evaluation.evaluate import EVALUATION_SEED, Evaluation, evaluate
from benchmarks.report import Advance, Benchmark, Findings, Measurement
from mbn_marl.config import Condition
from mbn_marl.errors import ConfigError, collecting
from mbn_marl.field import catalogue_names

ZOO = {"zoo": True, "zoo-sampled": False}
"""The zoo's two ways to act, and whether actions are the mean ones."""
POLICIES = (*ZOO, *CLASSICAL)
TARGETS = {"windy": 0.95, "gusty": 0.95, "failing": 0.95}
"""The success that greedy and the replanning planner are to have on every field."""
TARGETED = ("greedy", "replan")


@dataclass(frozen=True)
class Conditions(Benchmark):
    """Evaluate the zoo's policies, trained in calm, and the classical ones under each condition."""

    name: ClassVar[str] = "conditions"

    policies: tuple[str, ...] = POLICIES
    """Which of them; or a run or zoo:NAME, with mean actions."""
    conditions: tuple[Condition, ...] = get_args(Condition)
    """Under which conditions."""
    fields: tuple[str, ...] = tuple(catalogue_names())
    """Names of `mbn fields`."""
    episodes: int = 100
    """How many episodes of each."""
    seed: int = EVALUATION_SEED
    """Of the episodes; by default that of all evaluations."""

    @property
    def stages(self) -> int:  # type: ignore[override]
        """One for each policy and condition."""
        return len(self.policies) * len(self.conditions)

    def measure(self, advance: Advance) -> Findings:
        """Evaluate every policy on every field under every condition."""
        problems: list[str] = []
        for policy in (name for name in self.policies if name not in POLICIES):
            with collecting(problems):
                load_policy(policy, self.fields[0])
        if problems:
            raise ConfigError("conditions", problems)
        found: dict[str, dict[str, dict[str, Any]]] = {}
        for policy in self.policies:
            for condition in self.conditions:
                cells = {field: self._evaluate(policy, field, condition) for field in self.fields}
                known = {field: cell.summary() for field, cell in cells.items() if cell}
                found.setdefault(policy, {})[condition] = known
                advance()
        rows = [
            Measurement(f"{policy}, {condition}: lowest success of a field", worst, "", target)
            for policy in TARGETED
            for condition, target in TARGETS.items()
            if (worst := _lowest(found.get(policy, {}).get(condition, {}))) is not None
        ]
        return Findings(
            f"{len(self.fields)} fields, {self.episodes} episodes each, seed {self.seed}",
            rows,
            tables={"success: mean over fields (lowest)": _table(found, _success)}
            | {"return: mean over fields": _table(found, _return)},
            details={"evaluations": found},
        )

    def _evaluate(self, policy: str, name: str, condition: Condition) -> Evaluation | None:
        """Evaluate on a field; ``None`` if the policy refuses the condition."""
        how: dict[str, Any] = {"episodes": self.episodes, "seed": self.seed}
        try:
            loaded = load_policy("zoo" if policy in ZOO else policy, name, condition=condition)
            how["deterministic"] = ZOO.get(policy, policy not in CLASSICAL)
            return evaluate(loaded, name, loaded.settings, **how)
        except ConfigError:
            return None


def _lowest(cells: Mapping[str, Mapping[str, Any]]) -> float | None:
    return min((cell["success_rate"] for cell in cells.values()), default=None)


def _success(cells: Mapping[str, Mapping[str, Any]]) -> str:
    mean = np.mean([cell["success_rate"] for cell in cells.values()])
    return f"{mean:.1%} ({_lowest(cells):.0%})"


def _return(cells: Mapping[str, Mapping[str, Any]]) -> str:
    return f"{np.mean([cell['return_mean'] for cell in cells.values()]):,.0f}"


def _table(found: Mapping[str, Mapping[str, Any]], show: Any) -> TextTable:
    """Return a row for each condition, a column for each policy; - where it refuses."""
    lines = (
        (name, *(show(rows[name]) if rows[name] else "-" for rows in found.values()))
        for name in next(iter(found.values()))
    )
    return TextTable("", ("condition", *found), tuple(lines))
