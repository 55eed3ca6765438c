"""Algorithms of Stable-Baselines3: on the single MDP, and with one policy for all robots."""
