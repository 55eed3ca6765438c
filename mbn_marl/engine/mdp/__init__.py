"""The paper: each equation one function, for the CPU and the GPU alike; ``docs/mdp.md`` lists them.

Nothing here knows how worlds are stored, shared among threads or launched on a device.
"""
