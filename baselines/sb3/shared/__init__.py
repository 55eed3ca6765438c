"""One policy for all robots: PPO of Stable-Baselines3 on rows of robots."""
