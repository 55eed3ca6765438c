"""PPO of Stable-Baselines3 with one policy for all robots, each robot a row of the batch."""
