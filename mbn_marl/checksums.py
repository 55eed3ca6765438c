"""Checksums: ``checksums.json`` lists a folder's files, and whoever reads one checks it first.

A file that the list does not name is not checked, and neither is a folder without a list: what
people write by hand, and what older versions wrote.
"""

from __future__ import annotations

import hashlib
import hmac
import json
from collections.abc import Iterable
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

from mbn_marl.errors import DamageError

LIST = "checksums.json"


def digest(data: bytes) -> str:
    """The SHA-256 of ``data``, in hexadecimal."""
    return hashlib.sha256(data).hexdigest()


def digest_of_json(value: Any) -> str:
    """The SHA-256 of a JSON value, however it is laid out in a file."""
    return digest(_canonical(value))


def make_list(
    folder: Path, names: Iterable[str] | None = None, *, key: bytes | None = None
) -> dict[str, Any]:
    """The list of files in ``folder``, as JSON values; once it is there, none of them may change.

    Args:
        folder: where they are.
        names: of the files, of which those count that are there; ``None`` for every one that is not
            hidden.
        key: signs the list, see :func:`is_signed`.
    """
    found = {path.name for path in folder.iterdir() if path.is_file()} - {LIST}
    chosen = {name for name in found if not name.startswith(".")} if names is None else {*names}
    files = {name: _digest_of_file(folder / name) for name in sorted(chosen & found)}
    signature = {} if key is None else {"signature": _signature(files, key)}
    return {"sha256": files, **signature}


def read_checked(folder: Traversable, name: str) -> bytes:
    """The bytes of the file ``name`` in ``folder``.

    Raises:
        DamageError: they are not those that the folder's list was made of, or it is damaged.
        OSError: the file cannot be read.
    """
    data = folder.joinpath(name).read_bytes()
    _compare(folder, name, digest(data))
    return data


def check(path: Path) -> None:
    """Whether the file at ``path``, which may be large, is what its folder's list says.

    Raises:
        DamageError: it is not.
        OSError: it cannot be read.
    """
    _compare(path.parent, path.name, _digest_of_file(path))


def is_signed(path: Path, key: bytes) -> bool:
    """Whether the list beside the file at ``path`` names it, and was signed with ``key``.

    Raises:
        DamageError: the list is damaged.
    """
    files, signature = listed(path.parent), _list(path.parent).get("signature")
    return (
        path.name in files
        and isinstance(signature, str)
        and hmac.compare_digest(signature.encode(errors="replace"), _signature(files, key).encode())
    )


def listed(folder: Traversable) -> dict[str, str]:
    """The checksums that a folder lists, by file; none without a list.

    Raises:
        DamageError: the list is damaged.
    """
    files = _list(folder).get("sha256", {})
    if not isinstance(files, dict):
        raise DamageError(f"{folder.joinpath(LIST)} is damaged: sha256 has to map names")
    return files


def _compare(folder: Traversable, name: str, found: str) -> None:
    """Raise an error if a file does not have the checksum that its folder lists."""
    if listed(folder).get(name, found) != found:
        raise DamageError(
            f"{folder.joinpath(name)} is damaged: it is not what {LIST} beside it was made of; "
            "restore it, or, if it was changed on purpose, take its line out there"
        )


def _digest_of_file(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _signature(files: dict[str, str], key: bytes) -> str:
    return hmac.new(key, _canonical(files), "sha256").hexdigest()


def _canonical(value: Any) -> bytes:
    return json.dumps(value, sort_keys=True, separators=(",", ":")).encode()


def _list(folder: Traversable) -> dict[str, Any]:
    """The list of a folder; of one without, an empty one."""
    place = folder.joinpath(LIST)
    if not place.is_file():
        return {}
    try:
        content = json.loads(place.read_bytes())
    except (ValueError, RecursionError) as error:  # not text, not JSON, or nested without end
        raise DamageError(f"{place} is damaged: {error}") from None
    if not isinstance(content, dict) or "sha256" not in content:
        raise DamageError(f"{place} is damaged: it has no entry sha256")
    return content
