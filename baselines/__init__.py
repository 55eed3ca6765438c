"""Training, evaluation and comparison of centralised and decentralised baselines."""
