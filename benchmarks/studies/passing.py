"""When runs pass, and what those of one label on one field reached."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

from baselines.compare.records import RunRecord
from baselines.evaluation import intervals as statistics
from baselines.paper import published

NEVER = float("inf")


@dataclass(frozen=True)
class Passing:
    """When a run first passed a fresh evaluation; ``NEVER`` in both for one that did not.

    A run passes when the mean return of fresh episodes with sampled actions is 100 000 or more, at
    least 99 % of them succeed, and so does the policy with mean actions.

    Attributes:
        env_steps: env-steps of that evaluation.
        seconds: wall time until then, evaluations included, from the start of training.
    """

    env_steps: float
    seconds: float

    @classmethod
    def of(cls, result: RunRecord) -> Passing:
        """The first of a run's evaluations that passes."""
        for entry in result.evaluations:
            if statistics.passes(entry, entry["deterministic_success_rate"]):
                return cls(entry["env_steps"], entry["wall_seconds"])
        return cls(NEVER, NEVER)


def passes(result: RunRecord) -> bool:
    """Return whether the final policy of a run passes."""
    final = result.evaluation
    return statistics.passes(final["stochastic"], final["deterministic"]["success_rate"])


def best_return(result: RunRecord) -> float:
    """The best return with mean actions of a run's evaluations, on the way or at the end."""
    on_the_way = [float(entry["deterministic_return_mean"]) for entry in result.evaluations]
    return max(result.final("deterministic", "return_mean"), *on_the_way)


@dataclass(frozen=True)
class FieldLine:
    """What the runs of one label on one field reached; ``None`` for never or unknown."""

    label: str
    field: str
    runs: int
    passed: int  # final policies that pass
    env_steps: float | None  # median to the first evaluation that passes
    worst_env_steps: float | None
    seconds: float | None  # median wall time to that evaluation
    return_mean: float  # with sampled actions
    success_rate: float  # of those episodes
    deterministic_median: float  # return with mean actions, of final policies
    deterministic_best: float  # of any evaluation, as the paper's tables have the best of training
    optimum: float | None  # the proved best return
    paper_best: float | None  # over its algorithms and settings

    @classmethod
    def of(cls, cell: Sequence[RunRecord]) -> FieldLine:
        """Summarise the runs of one label on one field."""
        firsts = [Passing.of(result) for result in cell]
        mean_actions = [result.final("deterministic", "return_mean") for result in cell]
        sampled = [result.evaluation["stochastic"] for result in cell]
        return cls(
            label=cell[0].label,
            field=cell[0].field.name,
            runs=len(cell),
            passed=sum(map(passes, cell)),
            env_steps=known(median(first.env_steps for first in firsts)),
            worst_env_steps=known(max(first.env_steps for first in firsts)),
            seconds=known(median(first.seconds for first in firsts)),
            return_mean=sum(entry["return_mean"] for entry in sampled) / len(cell),
            success_rate=sum(entry["success_rate"] for entry in sampled) / len(cell),
            deterministic_median=median(mean_actions),
            deterministic_best=max(map(best_return, cell)),
            optimum=cell[0].optimum,
            paper_best=paper_best(cell[0].field.name),
        )


def paper_best(field: str) -> float | None:
    """The largest number that the paper has for a field, a mean of 100 training episodes."""
    cells = [cell for (name, _), cell in published.by_field().items() if name == field]
    return max((cell["max"] for cell in cells), default=None)


def known(value: float) -> float | None:
    """``None`` for never."""
    return None if value == NEVER else value
