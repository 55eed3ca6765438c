"""``python -m benchmarks fields``, in small."""

from __future__ import annotations

import pytest

from benchmarks import fields
from benchmarks.fields import Fields
from mbn_marl.errors import ConfigError, FieldError


def test_all_are_made_and_validated(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fields, "AT_ONCE", 3)
    stages: list[None] = []
    found = Fields(count=101).measure(lambda: stages.append(None))
    assert len(stages) == Fields().stages == 25
    assert found.title.startswith("125 random fields")
    assert found.measurements[-1].value == 0 and all(row.value for row in found.measurements[:-1])


def test_what_is_invalid_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(tables: object, arena: object, name: str, f: int) -> None:
        if name.startswith("farm"):
            raise FieldError("field", ["starts[0]: is outside the field"])

    monkeypatch.setattr(fields, "field_of", refuse)
    found = Fields(count=25).measure(lambda: None)
    assert (found.measurements[-1].value, found.measurements[-1].met) == (5, False)
    assert "starts[0]: is outside" in found.remarks[0]
    with pytest.raises(ConfigError, match="count: at least 1, not 0"):
        Fields(count=0).measure(lambda: None)
