"""The catalogue: the field files installed with the package."""

from __future__ import annotations

from importlib.resources import files

_FOLDER = files("envs_catalog")


def catalogue_names() -> list[str]:
    """Return the names of the catalogue's fields, sorted."""
    suffix = ".yaml"
    return sorted(
        entry.name.removesuffix(suffix)
        for entry in _FOLDER.iterdir()
        if entry.name.endswith(suffix)
    )


def catalogue_file(name: str) -> bytes:
    """Return the bytes of the file of the catalogue field ``name``."""
    return _FOLDER.joinpath(f"{name}.yaml").read_bytes()
