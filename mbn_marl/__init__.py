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
    from mbn_marl.adapters.gymnasium import centralized_env as centralized_env
    from mbn_marl.config import Failures as Failures
    from mbn_marl.config import Uniform as Uniform
    from mbn_marl.engine import BatchEngine as BatchEngine
    from mbn_marl.field import Field as Field
    from mbn_marl.field import FieldSampler as FieldSampler
    from mbn_marl.field import generate as generate
    from mbn_marl.field import load_field as load_field
    from mbn_marl.navigation_v0 import env as env
    from mbn_marl.navigation_v0 import parallel_env as parallel_env
    from mbn_marl.navigation_v0 import raw_env as raw_env

_NAMES = {
    "adapters.gymnasium": ["centralized_env"],
    "config": ["Failures", "Uniform"],
    "engine": ["BatchEngine"],
    "field": ["Field", "FieldSampler", "generate", "load_field"],
    "navigation_v0": ["env", "parallel_env", "raw_env"],
}
_HOMES = {name: f"mbn_marl.{module}" for module, names in _NAMES.items() for name in names}
__all__ = sorted(_HOMES)


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
