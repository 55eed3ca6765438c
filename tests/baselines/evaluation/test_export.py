"""Policies as files that act as the policy and say what they need."""

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
from baselines.evaluation.export import OPSET, Network, export_policy
from baselines.evaluation.fitting import LoadedPolicy
from baselines.evaluation.layers import Layers, run_arrays
from baselines.sb3.config import algorithm_class
from baselines.sb3.layers import layers_of
from baselines.sb3.policy import Normalization, SB3Policy
from baselines.torchrl.entities import Tokens
from baselines.torchrl.networks import Actor, GaussianPolicy, Sharing, TeamShape
from baselines.torchrl.policy import TeamPolicy
from mbn_marl import BatchEngine, load_field, parallel_env
from mbn_marl.errors import ConfigError, MbnError
from tests.baselines.conftest import Refusal

pytestmark = pytest.mark.slow


def test_a_file_acts_as_the_policy_from_raw_observations(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "policy.onnx"
    assert main(["export", "zoo:field_07", "-o", str(path)]) == 0
    said = capfd.readouterr()
    assert not said.err
    for words in ("(W, 3, 55)", "observation='lidar'", "field_07", "+-10", str(path)):
        assert words in said.out
    onnx.checker.check_model(onnx.load(path), full_check=True)
    assert [entry.version for entry in onnx.load(path).opset_import] == [OPSET]
    session = onnxruntime.InferenceSession(path)
    metadata = json.loads(session.get_modelmeta().custom_metadata_map["mbn_marl"])
    policy = load_policy("zoo:field_07")
    env = parallel_env(metadata["field"], **metadata["environment"])
    assert {**metadata, "environment": {}} == {
        "policy": "zoo:field_07",
        "field": "field_07",
        "takes": "observations",
        "shape": ["W", *np.shape([*env.reset(seed=0)[0].values()])],
        "returns": ["W", 3, 2],
        "clip": 10.0,
        "environment": {},
        "version": metadata["version"],
    }
    seen = np.random.default_rng(1).uniform(-1.0, 1.0, (5, 3, 55)).astype(np.float32)
    for worlds in (seen, seen[2:3]):
        (actions,) = session.run(None, {"observations": worlds})
        assert actions.dtype == np.float32
        np.testing.assert_allclose(actions, policy.act(worlds), rtol=0, atol=1e-5)
    assert np.abs(policy.act(seen)).max() == 1.0  # some are clipped


FIELD = load_field("field_03")


def team(sharing: Sharing, actor: Actor, updates: int) -> LoadedPolicy:
    """A team's networks, normalised or not."""
    size = BatchEngine(FIELD, 1, threads=1).obs_size
    network = GaussianPolicy(TeamShape(size, 3, (8, 8), sharing, actor))
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


def library(algorithm: str, kind: str, normalized: bool = True, **arguments: Any) -> LoadedPolicy:
    """A fresh policy of Stable-Baselines3 for three robots on the paper's state."""
    bounds = spaces.Box(-np.inf, np.inf, (13,), np.float32), spaces.Box(-1, 1, (3, 2), np.float32)
    rate = {} if algorithm == "ars" else {"lr_schedule": ConstantSchedule(0.0)}
    network = algorithm_class(algorithm).policy_aliases[kind](*bounds, **rate, **arguments)
    for module in network.modules():
        if isinstance(module, BatchRenorm):  # as after a training
            for tensor in (module.ra_mean, module.scale.data, module.bias.data):
                tensor.normal_()
            module.ra_var.uniform_(0.5, 2.0)
    norm = Normalization(np.full(13, 60.0), np.full(13, 900.0), 5.0, 1e-8, 2.0)
    shape: dict[str, Any] = {"algorithm": algorithm, "obs_size": 13, "action_shape": [3, 2]}
    shape["observes"] = "state"
    policy = SB3Policy(network, shape, norm if normalized else None)
    return LoadedPolicy("mine", policy, {}, FIELD)


def test_every_network_becomes_arrays_that_act_as_it_does(tmp_path: Path) -> None:
    torch.manual_seed(0)
    random = np.random.default_rng(0)
    net = {"net_arch": [8, 8]}
    policies = [
        team("full", "decentralized", 0),
        team("none", "decentralized", 1),
        team("none", "centralized", 1),
        *(sets(assignment=one) for one in (True, False)),
        library("ppo", "MlpPolicy", **net),
        library("ppo", "MlpPolicy", False, **net),
        library("ars", "LinearPolicy"),
        library("tqc", "MlpPolicy", **net),
        library("crossq", "MlpPolicy", **net),
    ]
    for number, policy in enumerate(policies):
        path = tmp_path / f"{number}.npz"
        export_policy(policy, path)
        engine = BatchEngine(FIELD, 1, threads=1, **policy.settings)
        state = policy.observes == "state"
        size = (30, 13) if state else (30, 3, engine.obs_size)
        seen = random.uniform(-1.0, 1.0, size).astype(np.float32)
        seen[random.random(size) < 0.3] = 0.0
        seen = 60.0 * seen + 60.0 if state else seen
        expected = policy.act(seen)
        actions = run_arrays(dict(np.load(path)), seen)
        assert actions.dtype == np.float32
        np.testing.assert_allclose(actions, expected, rtol=0, atol=1e-5)
        assert len(np.unique(actions)) > 10, number


@pytest.mark.all
def test_other_kinds_of_policies_and_files(tmp_path: Path) -> None:
    for number, policy in enumerate(
        [
            load_policy("zoo:generalist", "field_03"),
            load_policy("zoo:generalist-hint", "field_03"),
            library("ppo", "MlpPolicy", net_arch=[8]),
        ]
    ):
        for ending in (".onnx", ".pt2", ".npz"):
            export_policy(policy, tmp_path / f"{number}{ending}")  # which compares the actions


def test_rows_that_are_not_clipped_are_normalised() -> None:
    mean, scale = np.full((1, 1, 2), 3.0), np.full((1, 1, 2), 2.0)
    network = np.full((1, 2, 2), 0.25, np.float32), np.zeros((1, 1, 2), np.float32)
    layers = Layers(mean, scale, np.inf, (network[0],), (network[1],), ("tanh",))
    seen = np.array([[[5.0, 9.0]]], np.float32)
    assert run_arrays(layers.arrays(), seen) == pytest.approx(np.tanh(1.0))
    assert Network(layers)(torch.from_numpy(seen)).numpy() == pytest.approx(np.tanh(1.0))


def test_what_cannot_be_exported_is_named(
    refusal: Refusal, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "taken.npz").touch()
    for words, place in (
        ("greedy -o policy.npz", "greedy: "),
        ("zoo -o policy.npz", "zoo: "),
        ("module:own -o policy.npz", "module:own: "),
        ("greedy -o policy.pt", "policy.pt: "),
        ("gredy -o policy.npz", "gredy"),
        ("zoo:generalist -o policy.npz", "field: "),
        ("zoo:field_07 -o policy.pt", "policy.pt: "),
        ("zoo:field_07 -o taken.npz", "taken.npz"),
    ):
        assert place in refusal(["export", *words.split()]), words
    for package in ("onnxruntime", "onnxscript"):
        with monkeypatch.context() as patch:
            patch.setitem(sys.modules, package, None)
            error = refusal(["export", "zoo:field_07", "-o", "policy.onnx"])
        assert package in error and ".[export]" in error


def test_networks_and_files_that_act_otherwise_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy: Any = library("ppo", "MlpPolicy", activation_fn=torch.nn.ELU).policy
    with pytest.raises(ConfigError, match="network: has ELU"):
        layers_of(policy.network, np.zeros(13), np.ones(13), 10.0)
    true = LoadedPolicy.act
    monkeypatch.setattr(LoadedPolicy, "act", lambda self, seen: true(self, seen) + 2e-4)
    with pytest.raises(MbnError, match=r"policy\.npz"):
        export_policy(load_policy("zoo:field_07"), tmp_path / "policy.npz")
    assert not (tmp_path / "policy.npz").exists()
