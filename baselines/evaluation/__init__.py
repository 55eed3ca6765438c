"""Policies in action: evaluation, wind sweeps, recorded episodes, intervals."""
