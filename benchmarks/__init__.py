"""Measurements of the suite that ``mbn bench`` runs: speed."""
