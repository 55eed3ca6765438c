"""Numba: compilation, exact elementary functions, random numbers, intrinsics."""
