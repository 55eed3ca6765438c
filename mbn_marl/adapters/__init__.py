"""Adapters of the engine: PettingZoo, Gymnasium, Stable-Baselines3, TorchRL.

Each library has its own module, imported by name, so that none needs the others' packages.
"""
