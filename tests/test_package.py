"""The package's public names, loaded on first use."""

from __future__ import annotations

import pytest

import mbn_marl


def test_public_names():
    expected = {"parallel_env", "env", "raw_env", "centralized_env"}
    expected |= {"Field", "load_field", "BatchEngine"}
    assert set(mbn_marl.__all__) == expected
    assert expected <= set(dir(mbn_marl))
    assert all(callable(getattr(mbn_marl, name)) for name in mbn_marl.__all__)
    assert mbn_marl.parallel_env is mbn_marl.navigation_v0.parallel_env


def test_an_unknown_name_is_an_error_that_names_it():
    with pytest.raises(AttributeError, match="'mbn_marl' has no attribute 'paralell_env'"):
        _ = mbn_marl.paralell_env
