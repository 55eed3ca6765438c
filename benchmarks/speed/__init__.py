"""How fast the engine and its adapters are, against a plain loop and other suites."""
