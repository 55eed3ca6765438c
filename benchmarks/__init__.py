"""Measurements of the suite, for a checkout: ``python -m benchmarks SUBJECT``."""
