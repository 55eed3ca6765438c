"""Algorithms of Stable-Baselines3 on the centralised single MDP."""
