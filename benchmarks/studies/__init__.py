"""The benchmarks of learning: comparisons, and a search for the best policies."""
