"""What a policy acts on, in a word that tables show."""

from baselines.policies.policy import Policy, RandomPolicy
from baselines.policies.shielded import Shielded
from mbn_marl.config import NavigationConfig


def information(config: NavigationConfig) -> str:
    """Return ``"all"``, ``"assignment"`` (a planner's output) or ``"own sight"``, of robots."""
    if config.assignment:
        return "assignment"
    blind = config.observation in ("local", "lidar_local") or config.dropout == 1.0
    return "own sight" if blind else "all"


def information_of(policy: Policy, config: NavigationConfig) -> str:
    """Return also ``"state"``, that of the environment, or ``"-"`` of a policy that ignores all."""
    if isinstance(policy, Shielded) or policy.observes == "state":
        return "state"
    return "-" if isinstance(policy, RandomPolicy) else information(config)
