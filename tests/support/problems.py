"""The places that the errors of refused calls name."""

from collections.abc import Callable
from typing import Any

import pytest

from mbn_marl.errors import ProblemsError


def places_of(
    error: type[ProblemsError], call: Callable[..., Any], *given: Any, **named: Any
) -> list[str]:
    with pytest.raises(error) as caught:
        call(*given, **named)
    return [problem.split(": ")[0] for problem in caught.value.problems]
