"""Policies by name: loaded, given the settings of an environment, fitted to a field."""
