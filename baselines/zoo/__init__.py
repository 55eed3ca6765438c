"""Trained policies that come with the package, as small run folders: ``zoo:field_03``."""
