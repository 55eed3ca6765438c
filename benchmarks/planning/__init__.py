"""The planner against its targets."""
