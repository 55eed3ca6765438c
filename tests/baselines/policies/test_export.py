"""Policies as ONNX files that act as the policy and say what they need."""

import json
import sys

import numpy as np
import onnx
import onnxruntime
import pytest

from baselines import load_policy
from baselines.algorithms import ALGORITHMS
from baselines.cli import main
from baselines.policies.export import OPSET, TOLERANCE, export_policy
from baselines.policies.loaded import LoadedPolicy
from mbn_marl import parallel_env
from mbn_marl.errors import MbnError
from mbn_marl.field import generate, save_field

pytestmark = pytest.mark.slow


def test_a_file_acts_as_the_policy_from_raw_observations(tmp_path, capfd):
    path = tmp_path / "policy.onnx"
    assert main(["export", "zoo:field_07", "-o", str(path)]) == 0
    said = capfd.readouterr()
    assert not said.err
    for words in ("(W, 3, 55)", "observation='lidar'", "field_07", str(path)):
        assert words in said.out
    onnx.checker.check_model(onnx.load(path), full_check=True)
    assert [entry.version for entry in onnx.load(path).opset_import] == [OPSET]
    session = onnxruntime.InferenceSession(path)
    metadata = json.loads(session.get_modelmeta().custom_metadata_map["mbn_marl"])
    policy = load_policy("zoo:field_07")
    env = parallel_env(metadata["field"], **metadata["environment"])
    assert {**metadata, "environment": {}} == {
        **{"policy": "zoo:field_07", "field": "field_07", "takes": "observations"},
        "shape": ["W", *np.shape([*env.reset(seed=0)[0].values()])],
        **{"returns": ["W", 3, 2], "environment": {}, "version": metadata["version"]},
    }
    seen = np.random.default_rng(1).uniform(-1.0, 1.0, (5, 3, 55)).astype(np.float32)
    for worlds in (seen, seen[2:3]):
        (actions,) = session.run(None, {"observations": worlds})
        assert actions.dtype == np.float32
        np.testing.assert_allclose(actions, policy.act(worlds), rtol=0, atol=1e-5)
    assert np.abs(policy.act(seen)).max() == 1.0  # some are clipped


GATE = ("crossq", "ppo-shared", "zoo:generalist")
ZOO = ("zoo:generalist", "zoo:generalist-hint")
CASES = [
    name if name in GATE else pytest.param(name, marks=pytest.mark.all)
    for name in (*ALGORITHMS, *ZOO)
]


@pytest.mark.parametrize("name", CASES)
def test_every_kind_of_network_acts_as_its_file(name, tmp_path, tiny_runs):
    policy = load_policy(name if name in ZOO else tiny_runs.finished(name).path, "field_03")
    metadata, _ = export_policy(policy, tmp_path / "policy.onnx")
    random, shape = np.random.default_rng(1), (50, *metadata["shape"][1:])
    seen = random.uniform(-1.0, 1.0, shape).astype(np.float32)
    seen[random.random(shape) < 0.3] = 0.0
    seen = 60.0 * seen + 60.0 if policy.observes == "state" else seen
    if name in ZOO:
        seen[2:4, 1] = 0.0  # a robot that is not in the team
    session = onnxruntime.InferenceSession(tmp_path / "policy.onnx")
    (actions,) = session.run(None, {policy.observes: seen})
    np.testing.assert_allclose(actions, policy.act(seen), rtol=0, atol=TOLERANCE)
    assert len(np.unique(actions)) > 10


def test_what_cannot_be_exported_is_named(refusal, monkeypatch, tmp_path):
    (tmp_path / "taken.onnx").touch()
    save_field(generate("convex", 1, robots=2), tmp_path / "two.yaml")
    for words, place in (
        ("greedy -o policy.onnx", "greedy: "),
        ("zoo:generalist -o policy.onnx", "field: "),
        ("zoo:field_07 --field two.yaml -o policy.onnx", "trained with 3, here it is 2"),
        ("zoo:field_07 -o policy.pt2", "policy.pt2: "),
        ("zoo:field_07 -o taken.onnx", "taken.onnx"),
    ):
        assert place in refusal(["export", *words.split()]), words
    for package in ("onnxruntime", "onnxscript"):
        with monkeypatch.context() as patch:
            patch.setitem(sys.modules, package, None)
            error = refusal(["export", "zoo:field_07", "-o", "policy.onnx"])
        assert package in error and ".[export]" in error


def test_a_file_that_acts_otherwise_is_refused(tmp_path, monkeypatch):
    true = LoadedPolicy.act
    monkeypatch.setattr(LoadedPolicy, "act", lambda self, seen: true(self, seen) + 2e-4)
    with pytest.raises(MbnError, match=r"policy\.onnx"):
        export_policy(load_policy("zoo:field_07"), tmp_path / "policy.onnx")
    assert not (tmp_path / "policy.onnx").exists()
