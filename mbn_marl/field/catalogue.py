"""The catalogue: the field files installed with the package."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

_FOLDER = files("envs_catalog")


def catalogue_names() -> list[str]:
    """Return the names of the catalogue's fields, sorted."""
    names = (Path(entry.name) for entry in _FOLDER.iterdir())
    return sorted(name.stem for name in names if name.suffix == ".yaml")


def catalogue_file(name: str) -> bytes:
    """Return the bytes of the file of the catalogue field ``name``."""
    return _FOLDER.joinpath(f"{name}.yaml").read_bytes()
