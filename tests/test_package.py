"""The wheel, and the package's public names, loaded on first use."""

import zipfile

import pytest

import mbn_marl
from tests.support.pages import ROOT
from tests.support.wheel import build_wheel


def test_public_names():
    expected = {"parallel_env", "env", "raw_env", "centralized_env"}
    expected |= {"Field", "FieldSampler", "generate", "load_field"}
    expected |= {"BatchEngine", "Failures", "Uniform"}
    assert set(mbn_marl.__all__) == expected
    assert {*dir(mbn_marl)} == {*expected, "__version__"}
    assert all(callable(getattr(mbn_marl, name)) for name in mbn_marl.__all__)
    assert mbn_marl.parallel_env is mbn_marl.navigation_v0.parallel_env
    with pytest.raises(AttributeError, match="'paralell_env'"):
        _ = mbn_marl.paralell_env


@pytest.mark.slow
def test_the_wheel_has_three_packages_and_their_data(tmp_path):
    with zipfile.ZipFile(build_wheel(tmp_path)) as wheel:
        names = wheel.namelist()
    top = {name.split("/")[0] for name in names}
    info = f"mbn_marl-{mbn_marl.__version__}.dist-info"
    assert top == {"mbn_marl", "baselines", "envs_catalog", info}
    source = {
        str(path.relative_to(ROOT))
        for package in ("mbn_marl", "baselines", "envs_catalog")
        for path in (ROOT / package).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    left_out = {
        name for name in source - set(names) if not name.endswith(("README.md", ".txt", ".npz"))
    }
    assert left_out == set()
