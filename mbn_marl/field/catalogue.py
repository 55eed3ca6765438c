"""The catalogue: the files of fields, and of samplers, installed with the package."""

from __future__ import annotations

from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path

_FOLDER = files("envs_catalog")
_SAMPLERS = _FOLDER / "samplers"


def catalogue_names() -> list[str]:
    """Return the names of the catalogue's fields, sorted."""
    return _names_in(_FOLDER)


def catalogue_file(name: str) -> bytes:
    """Return the bytes of the file of the catalogue field ``name``."""
    return _FOLDER.joinpath(f"{name}.yaml").read_bytes()


def sampler_names() -> list[str]:
    """Return the names of the catalogue's samplers of random fields, sorted."""
    return _names_in(_SAMPLERS)


def sampler_file(name: str) -> bytes:
    """Return the bytes of the file of the catalogue sampler ``name``."""
    return _SAMPLERS.joinpath(f"{name}.yaml").read_bytes()


def _names_in(folder: Traversable) -> list[str]:
    names = (Path(entry.name) for entry in folder.iterdir())
    return sorted(name.stem for name in names if name.suffix == ".yaml")
