"""Differences between what a folder records and what a command asks for."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def differences(recorded: Mapping[str, Any], asked: Mapping[str, Any]) -> list[str]:
    """Return a line for each entry of ``asked`` that was recorded otherwise.

    Args:
        recorded: JSON values by name.
        asked: JSON values by name.
    """
    return [
        f"{name}: recorded is {recorded.get(name)!r}, asked for is {value!r}"
        for name, value in asked.items()
        if recorded.get(name) != value
    ]
