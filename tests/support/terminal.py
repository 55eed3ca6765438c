"""The command ``mbn``, as a user calls it."""

from __future__ import annotations

import sys

MBN = (sys.executable, "-c", "import sys; from baselines.cli import main; sys.exit(main())")
