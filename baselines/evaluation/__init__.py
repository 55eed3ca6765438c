"""Policies in action: evaluation, recorded episodes, intervals."""
