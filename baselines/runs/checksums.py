"""Checksums of checkpoints, policies and the zoo.

``checksums.json`` lists the SHA-256 of files beside it, which every reader of one checks first.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from mbn_marl.errors import DamageError

LIST = "checksums.json"


def digests_of(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of each file in ``folder`` by name, without hidden ones and the list."""
    files = (path for path in sorted(folder.iterdir()) if path.is_file())
    return {path.name: _digest(path) for path in files if path.name[0] != "." and path.name != LIST}


def check(path: Path) -> None:
    """Check that the file at ``path`` is what the list beside it says.

    Raises:
        DamageError: it is not, or the list is damaged.
        OSError: it cannot be read.
    """
    found = _digest(path)
    if _listed(path.parent).get(path.name, found) != found:
        raise DamageError(
            f"{path} is damaged: it is not what {LIST} beside it lists; restore it, or, if it was "
            "changed on purpose, remove its line there"
        )


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _listed(folder: Path) -> dict[str, Any]:
    """Return the checksums that ``folder`` lists, by file; none without a list."""
    place = folder / LIST
    if not place.is_file():
        return {}
    try:
        files = json.loads(place.read_bytes())["sha256"]
    except (ValueError, RecursionError, TypeError, LookupError) as error:
        raise DamageError(f"{place} is damaged: {error!r}") from None
    if not isinstance(files, dict):
        raise DamageError(f"{place} is damaged: sha256 must map names of files to checksums")
    return files
