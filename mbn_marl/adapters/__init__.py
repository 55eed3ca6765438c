"""The engine as others know it: PettingZoo, Gymnasium, Stable-Baselines3, TorchRL.

One module for each library, imported only by name, so that none needs the others' packages.
"""
