"""Multi-robot navigation as multi-agent reinforcement learning: fields, environments, engine.

Importing this package registers ``mbn/<field>-v0`` for every catalogue field with Gymnasium and
PettingZoo. The public names load their modules (and Numba with the engine) on first use.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from mbn_marl.registration import register_environments
from mbn_marl.version import __version__ as __version__

if TYPE_CHECKING:
    from mbn_marl.adapters.gymnasium import centralized_env
    from mbn_marl.config import Failures, Uniform
    from mbn_marl.engine import BatchEngine
    from mbn_marl.field import Field, FieldSampler, generate, load_field
    from mbn_marl.navigation_v0 import env, parallel_env, raw_env

__all__ = [
    "BatchEngine",
    "Failures",
    "Field",
    "FieldSampler",
    "Uniform",
    "centralized_env",
    "env",
    "generate",
    "load_field",
    "parallel_env",
    "raw_env",
]

_HOMES = {
    "BatchEngine": "mbn_marl.engine",
    "Failures": "mbn_marl.config",
    "Field": "mbn_marl.field",
    "FieldSampler": "mbn_marl.field",
    "Uniform": "mbn_marl.config",
    "centralized_env": "mbn_marl.adapters.gymnasium",
    "env": "mbn_marl.navigation_v0",
    "generate": "mbn_marl.field",
    "load_field": "mbn_marl.field",
    "parallel_env": "mbn_marl.navigation_v0",
    "raw_env": "mbn_marl.navigation_v0",
}


def __getattr__(name: str) -> object:
    """Load the module of a public name on first use (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        value = getattr(import_module(_HOMES[name]), name)
    except AttributeError as error:  # Python would say that the package has no such name
        raise ImportError(f"{_HOMES[name]}: {error}") from error
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the public names, loaded or not."""
    return [*__all__, "__version__"]


register_environments()
