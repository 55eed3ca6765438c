"""A grid of training runs: declared in a file, done on one machine or on many."""
