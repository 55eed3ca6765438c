"""What a policy does: evaluation, wind sweeps, recorded episodes, intervals."""
