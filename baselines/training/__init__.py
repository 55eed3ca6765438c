"""One training: configuration, hyperparameters, the loop around a learner, its logs."""
