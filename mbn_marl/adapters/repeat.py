"""The attribute ``action_repeat`` of the batched adapters."""

from __future__ import annotations

from operator import index
from typing import Any

from mbn_marl.errors import ConfigError


class ActionRepeat:
    """Env-steps of a step, all with the same action: an int, at least 1.

    Raises:
        ConfigError: another value is set.
    """

    def __get__(self, env: Any, kind: type) -> Any:
        """Return the number, or of the class this object."""
        return self if env is None else vars(env)["_action_repeat"]

    def __set__(self, env: Any, value: int) -> None:
        """Check and set the number."""
        try:
            number = index(value)
        except TypeError:
            number = 0
        if number < 1:
            problem = f"action_repeat: must be a whole number, at least 1 (got {value!r:.80})"
            raise ConfigError(type(env).__name__, [problem])
        vars(env)["_action_repeat"] = number
