"""Runs a command in a pseudo-terminal, as a user sees it."""

from __future__ import annotations

import os
import pty
import re
import subprocess
from collections.abc import Sequence

ESCAPES = re.compile(r"\x1b\[[0-9;?]*[a-zA-Z]")


def in_terminal(command: Sequence[str], columns: int = 80, code: int = 0) -> str:
    """What ``command`` writes to a terminal so many columns wide, without colours.

    It has to end with the exit status ``code``.
    """
    leader, follower = pty.openpty()
    environment = {**os.environ, "COLUMNS": str(columns), "TERM": "xterm"}
    process = subprocess.Popen(command, stdout=follower, stderr=follower, env=environment)
    os.close(follower)
    written = b""
    try:
        while block := os.read(leader, 4096):
            written += block
    except OSError:  # the other end is closed
        pass
    os.close(leader)
    assert process.wait() == code, written.decode()
    return ESCAPES.sub("", written.decode()).replace("\r\n", "\n")
