"""Greedy and planner as policies, demonstrations, behaviour cloning."""
