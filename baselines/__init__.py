"""Training, evaluation and comparison of centralised and decentralised baselines."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from baselines.evaluation.policy import TrainedPolicy

__all__ = ["load_policy"]


def load_policy(source: str | Path) -> TrainedPolicy:
    """Load a trained policy, from a run of yours or from the zoo; it is ready to act.

    ``policy.observes`` says what it acts on: ``"observations"``, an array (worlds, n, obs_size), or
    ``"state"``, the paper's vector (worlds, 4n+1). ``policy.act(seen, deterministic=True)`` returns
    the actions (worlds, n, 2), shares of the full force in [-1, 1] once the environment clips them.

    Args:
        source: the folder of a run (of an unfinished one, its newest checkpoint counts), or
            ``"zoo:NAME"``, a policy of ``mbn zoo``.

    Raises:
        MbnError: the zoo has no such policy; the message lists those it has.
        RunError: there is no run, or it has saved no policy, or an older version wrote it.
        DamageError: a file of the policy is not what was written.
    """
    from baselines.evaluation.policy import load_policy
    from baselines.zoo.entries import open_run

    return load_policy(open_run(str(source)))
