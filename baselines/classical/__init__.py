"""Policies without learning (greedy, planner), demonstrations, behaviour cloning."""
