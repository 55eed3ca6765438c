"""Version 0 of the decentralised environment, under PettingZoo's usual names."""

# ``parallel_env``: all robots act at once. ``env``: one robot acts after the other (AEC), with
# PettingZoo's order checks. ``raw_env``: AEC without them.

from mbn_marl.adapters.pettingzoo import env, parallel_env, raw_env

__all__ = ["env", "parallel_env", "raw_env"]
