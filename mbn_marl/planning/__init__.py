"""The planner: proved optima of fields."""

from mbn_marl.planning.planner import Plan, UnsolvableError, plan

__all__ = ["Plan", "UnsolvableError", "plan"]
