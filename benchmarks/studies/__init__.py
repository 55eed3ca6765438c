"""The benchmarks of learning."""
