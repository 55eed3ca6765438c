"""The command ``mbn``, and a pseudo-terminal to run it in, as a user sees it."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import struct
import subprocess
import sys
import termios
from collections.abc import Mapping, Sequence
from pathlib import Path

MBN = (sys.executable, "-c", "import sys; from baselines.cli import main; sys.exit(main())")
CONTROL = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]|\x1b\][^\x07]*\x07")


def in_terminal(
    command: Sequence[str],
    columns: int = 80,
    *,
    folder: Path | None = None,
    environment: Mapping[str, str] = os.environ,
) -> str:
    """Return what a command that succeeds leaves on a terminal, without colours."""
    leader, follower = pty.openpty()
    fcntl.ioctl(follower, termios.TIOCSWINSZ, struct.pack("HHHH", 50, columns, 0, 0))
    process = subprocess.Popen(
        command,
        cwd=folder,
        env={**environment, "COLUMNS": str(columns), "TERM": "xterm-256color"},
        stdin=follower,
        stdout=follower,
        stderr=follower,
    )
    os.close(follower)
    written = b""
    try:
        while block := os.read(leader, 1 << 16):
            written += block
    except OSError:  # the other end is closed
        pass
    os.close(leader)
    text = CONTROL.sub("", written.decode("utf-8")).replace("\r\n", "\n")
    assert process.wait() == 0, f"in a terminal, exit code {process.returncode}: {text[-2000:]}"
    return "\n".join(line.rsplit("\r", 1)[-1] for line in text.split("\n"))
