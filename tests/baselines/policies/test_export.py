"""Policies as ONNX files that act as the policy and say what they need."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from gymnasium import spaces
from sb3_contrib.common.torch_layers import BatchRenorm
from stable_baselines3.common.utils import ConstantSchedule

from baselines import load_policy
from baselines.cli import main
from baselines.policies.export import OPSET, TOLERANCE, export_policy
from baselines.policies.loaded import LoadedPolicy
from baselines.sb3.config import algorithm_class
from baselines.sb3.policy import Normalization, SB3Policy
from baselines.torchrl.entities import Tokens
from baselines.torchrl.networks import GaussianPolicy, TeamShape
from baselines.torchrl.policy import TeamPolicy
from mbn_marl import BatchEngine, load_field, parallel_env
from mbn_marl.errors import MbnError
from tests.baselines.conftest import Refusal

pytestmark = pytest.mark.slow
FIELD = load_field("field_03")


def test_a_file_acts_as_the_policy_from_raw_observations(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
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


def team(updates: int = 0, **shape: Any) -> LoadedPolicy:
    """A team's networks, normalised or not."""
    size = BatchEngine(FIELD, 1, threads=1).obs_size
    network = GaussianPolicy(TeamShape(size, 3, (8, 8), **shape))
    torch.nn.init.normal_(network.mean.weights[-1])
    for _ in range(updates):
        network.norm.statistics.update(torch.rand(100, 3, size) + 1.0)
    return LoadedPolicy("mine", TeamPolicy(network), {}, FIELD)


def sets(**settings: Any) -> LoadedPolicy:
    """A network over sets."""
    settings |= {"observation": "entities"}
    engine = BatchEngine(FIELD, 1, threads=1, **settings)
    tokens = Tokens.of(engine.observation_table)
    network = GaussianPolicy(TeamShape(engine.obs_size, 3, (8, 12), "full", tokens=tokens))
    torch.nn.init.normal_(network.mean.head.weight)
    return LoadedPolicy("mine", TeamPolicy(network), settings, FIELD)


def library(algorithm: str, kind: str = "MlpPolicy", norm: bool = True) -> LoadedPolicy:
    """A fresh policy of Stable-Baselines3 for three robots on the paper's state."""
    bounds = spaces.Box(-np.inf, np.inf, (13,), np.float32), spaces.Box(-1, 1, (3, 2), np.float32)
    own = {"lr_schedule": ConstantSchedule(0.0), "net_arch": [8, 8]} if kind == "MlpPolicy" else {}
    network = algorithm_class(algorithm).policy_aliases[kind](*bounds, **own)
    for module in network.modules():
        if isinstance(module, BatchRenorm):  # as after a training
            for tensor in (module.ra_mean, module.scale.data, module.bias.data):
                tensor.normal_()
            module.ra_var.uniform_(0.5, 2.0)
    shape = {"algorithm": algorithm, "obs_size": 13, "action_shape": [3, 2], "observes": "state"}
    normal = Normalization(np.full(13, 60.0), np.full(13, 900.0), 5.0, 1e-8, 2.0)
    return LoadedPolicy("mine", SB3Policy(network, shape, normal if norm else None), {}, FIELD)


GATE = {
    "one for each robot": lambda: team(1, sharing="none"),
    "sets": lambda: sets(assignment=False),
    "crossq": lambda: library("crossq"),
}
ALL = {
    "shared": lambda: team(sharing="full"),
    "centralised": lambda: team(1, sharing="none", actor="centralized"),
    "sets, assigned": lambda: sets(assignment=True),
    "ppo": lambda: library("ppo"),
    "ppo, not normalised": lambda: library("ppo", norm=False),
    "ars": lambda: library("ars", "LinearPolicy"),
    "tqc": lambda: library("tqc"),
    "generalist": lambda: load_policy("zoo:generalist", "field_03"),
    "generalist-hint": lambda: load_policy("zoo:generalist-hint", "field_03"),
}
CASES = [*GATE, *(pytest.param(name, marks=pytest.mark.all) for name in ALL)]


@pytest.mark.parametrize("name", CASES)
def test_every_kind_of_network_acts_as_its_file(name: str, tmp_path: Path) -> None:
    torch.manual_seed(0)
    policy = {**GATE, **ALL}[name]()
    metadata, _ = export_policy(policy, tmp_path / "policy.onnx")
    shape = 7, *metadata["shape"][1:]
    random = np.random.default_rng(1)
    seen = random.uniform(-1.0, 1.0, shape).astype(np.float32)
    seen[random.random(shape) < 0.3] = 0.0
    seen = 60.0 * seen + 60.0 if policy.observes == "state" else seen
    if policy.observes == "observations":
        seen[2:4, 1] = 0.0  # a robot that is not in the team
    session = onnxruntime.InferenceSession(tmp_path / "policy.onnx")
    (actions,) = session.run(None, {policy.observes: seen})
    np.testing.assert_allclose(actions, policy.act(seen), rtol=0, atol=TOLERANCE)
    assert len(np.unique(actions)) > 10


def test_what_cannot_be_exported_is_named(
    refusal: Refusal, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "taken.onnx").touch()
    for words, place in (
        ("greedy -o policy.onnx", "greedy: "),
        ("zoo -o policy.onnx", "zoo: "),
        ("module:own -o policy.onnx", "module:own: "),
        ("gredy -o policy.onnx", "gredy"),
        ("zoo:generalist -o policy.onnx", "field: "),
        ("zoo:field_07 -o policy.pt2", "policy.pt2: "),
        ("zoo:field_07 -o taken.onnx", "taken.onnx"),
    ):
        assert place in refusal(["export", *words.split()]), words
    for package in ("onnxruntime", "onnxscript"):
        with monkeypatch.context() as patch:
            patch.setitem(sys.modules, package, None)
            error = refusal(["export", "zoo:field_07", "-o", "policy.onnx"])
        assert package in error and ".[export]" in error


def test_a_file_that_acts_otherwise_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    true = LoadedPolicy.act
    monkeypatch.setattr(LoadedPolicy, "act", lambda self, seen: true(self, seen) + 2e-4)
    with pytest.raises(MbnError, match=r"policy\.onnx"):
        export_policy(load_policy("zoo:field_07"), tmp_path / "policy.onnx")
    assert not (tmp_path / "policy.onnx").exists()
