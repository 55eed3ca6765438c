"""The common part of all compiled rules: compiler settings, random numbers, exact functions."""
