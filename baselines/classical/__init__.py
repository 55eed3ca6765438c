"""Policies without learning: greedy, planner, replan."""
