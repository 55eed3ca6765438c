"""A policy on a screen, or on simulated vehicles."""
