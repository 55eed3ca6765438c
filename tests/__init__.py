"""The tests, a package so that they can share the oracle, the golden episodes and the worlds."""
