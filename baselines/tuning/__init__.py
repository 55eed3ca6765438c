"""Tuning hyperparameters with Optuna, as the paper did for its setting B."""
