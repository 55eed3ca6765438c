"""The paper: each equation one function, for CPU and GPU alike; ``docs/mdp.md`` lists them."""

# Nothing here knows how worlds are stored, shared among threads or launched on a device.
