"""Whose files may run code: Stable-Baselines3's hold pickled parts, and unpickling runs them.

Every user has a key of random bytes, which signs the checksums of the policies and checkpoints that
this user trains. A file that is listed there was made here; any other one is loaded if the user
says so.
"""

from __future__ import annotations

import os
import secrets
import tempfile
from contextlib import suppress
from pathlib import Path

from baselines.runs.files import RunError
from mbn_marl.checksums import is_signed

KEY_BYTES = 32


class TrustError(RunError):
    """A file could run code when it is loaded, and was not made by this user."""


def key_file() -> Path:
    """Where this user's key is."""
    home = os.environ.get("XDG_CONFIG_HOME")
    return (Path(home) if home else Path.home() / ".config") / "mbn_marl" / "key"


def own_key() -> bytes | None:
    """This user's key, made on first use; ``None`` where it can be neither read nor made."""
    try:
        path = key_file()
        if not path.exists():
            _make_key(path)
        key = path.read_bytes()
    except (OSError, RuntimeError):  # no home, or one that cannot be written
        return None
    return key if len(key) == KEY_BYTES else None


def check_trusted(path: Path) -> None:
    """Whether this user made the pickled file at ``path``.

    Raises:
        TrustError: no list of checksums beside it names the file and is signed with the user's key.
        DamageError: that list is damaged.
    """
    key = own_key()
    if key is None or not is_signed(path, key):
        raise TrustError(
            f"{path} holds pickled parts, so loading it can run any code; it was not made by you "
            f"(no signature of {key_file()}). If you trust who made it, pass --trust"
        )


def _make_key(path: Path) -> None:
    """Make a key that only this user can read; of two processes at once, one does."""
    path.parent.mkdir(parents=True, exist_ok=True)
    number, temporary = tempfile.mkstemp(dir=path.parent)  # with mode 600
    try:
        with os.fdopen(number, "wb") as file:
            file.write(secrets.token_bytes(KEY_BYTES))
        with suppress(FileExistsError):
            path.hardlink_to(temporary)
    finally:
        Path(temporary).unlink()
