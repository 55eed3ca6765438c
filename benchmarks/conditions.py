"""The zoo's policies and the classical ones under every named condition."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from typing import Any, ClassVar, get_args

import numpy as np

from baselines import load_policy
from baselines.compare.text_table import TextTable
from baselines.evaluation.evaluate import EVALUATION_SEED, evaluate
from baselines.policies.classical import CLASSICAL
from benchmarks.report import Benchmark, Findings
from mbn_marl.config import Condition
from mbn_marl.errors import ConfigError, collecting
from mbn_marl.field import catalogue_names

ZOO = {"zoo": True, "zoo-sampled": False}
"""The zoo's two ways to act, and whether actions are the mean ones."""
POLICIES = (*ZOO, *CLASSICAL)


@dataclass(frozen=True)
class Conditions(Benchmark):
    """Evaluate the zoo's policies, trained in calm, and the classical ones under each condition."""

    name: ClassVar[str] = "conditions"

    policies: tuple[str, ...] = POLICIES
    """Some of them; or a run or zoo:NAME, with mean actions."""
    conditions: tuple[Condition, ...] = get_args(Condition)
    """Under which conditions."""
    fields: tuple[str, ...] = tuple(catalogue_names())
    """Names of `mbn fields`."""
    episodes: int = 100
    """The number of episodes of each."""
    seed: int = EVALUATION_SEED
    """Of the episodes; by default that of all evaluations."""

    def measure(self) -> Findings:
        problems: list[str] = []
        for policy in (name for name in self.policies if name not in POLICIES):
            with collecting(problems):
                load_policy(policy, self.fields[0])
        if problems:
            raise ConfigError("conditions", problems)
        found = {
            policy: {condition: self._cells(policy, condition) for condition in self.conditions}
            for policy in self.policies
        }
        size = f"{len(self.fields)} fields, {self.episodes} episodes each, seed {self.seed}"
        shown = {
            "success: mean over fields (lowest)": _success,
            "return: mean over fields": _return,
        }
        tables = {}
        for title, show in shown.items():
            cells = [[show(one[name]) for one in found.values()] for name in self.conditions]
            lines = [(name, *row) for name, row in zip(self.conditions, cells, strict=True)]
            tables[title] = TextTable(size, ("condition", *found), lines)
        return Findings(tables, {"evaluations": found})

    def _cells(self, policy: str, condition: Condition) -> dict[str, dict[str, Any]]:
        # There is no cell where the policy refuses the condition.
        cells = {}
        how: dict[str, Any] = {"episodes": self.episodes, "seed": self.seed}
        how["deterministic"] = ZOO.get(policy, policy not in CLASSICAL)
        for name in self.fields:
            with suppress(ConfigError):
                loaded = load_policy("zoo" if policy in ZOO else policy, name, condition=condition)
                cells[name] = evaluate(loaded, name, loaded.settings, **how).summary()
        return cells


def _success(cells: dict[str, dict[str, Any]]) -> str:
    rates = [cell["success_rate"] for cell in cells.values()]
    return f"{np.mean(rates):.1%} ({min(rates):.0%})" if rates else "-"


def _return(cells: dict[str, dict[str, Any]]) -> str:
    returns = [cell["return_mean"] for cell in cells.values()]
    return f"{np.mean(returns):,.0f}" if returns else "-"
