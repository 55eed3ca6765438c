"""Policies as ONNX, torch.export and NumPy files that act as the policy and say what they need."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from gymnasium import spaces
from sb3_contrib.common.torch_layers import BatchRenorm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.utils import ConstantSchedule

from baselines import load_policy
from baselines.cli import main
from baselines.evaluation.export import OPSET, Network, export_policy
from baselines.evaluation.fitting import LoadedPolicy
from baselines.evaluation.layers import Layers, run_arrays
from baselines.sb3.config import algorithm_class
from baselines.sb3.layers import layers_of
from baselines.sb3.policy import Normalization, SB3Policy
from baselines.torchrl.entities import SetActor, Tokens
from baselines.torchrl.networks import Actor, GaussianPolicy, Sharing, TeamShape
from baselines.torchrl.policy import TeamPolicy
from mbn_marl import BatchEngine, load_field, parallel_env
from mbn_marl.errors import ConfigError
from tests.baselines.conftest import Refusal

Seen = np.ndarray
SETS: dict[str, Any] = {"threads": 1, "observation": "entities"}
Read = Callable[[Path], tuple[Callable[[Seen], np.ndarray], str]]


def read_onnx(path: Path) -> tuple[Callable[[Seen], np.ndarray], str]:
    onnx.checker.check_model(onnx.load(path), full_check=True)
    assert [entry.version for entry in onnx.load(path).opset_import] == [OPSET]
    session = onnxruntime.InferenceSession(path)
    metadata = session.get_modelmeta().custom_metadata_map["mbn_marl"]
    return lambda seen: session.run(None, {"observations": seen})[0], metadata


def read_pt2(path: Path) -> tuple[Callable[[Seen], np.ndarray], str]:
    extra = {"mbn_marl": ""}
    module = torch.export.load(path, extra_files=extra).module()
    return lambda seen: module(torch.from_numpy(seen)).numpy(), extra["mbn_marl"]


def read_npz(path: Path) -> tuple[Callable[[Seen], np.ndarray], str]:
    file = dict(np.load(path))
    return lambda seen: run_arrays(file, seen), str(file["mbn_marl"])


@pytest.mark.parametrize("read", [read_onnx, read_pt2, read_npz])
def test_a_file_acts_as_the_policy_from_raw_observations(
    read: Read, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / f"policy.{read.__name__.removeprefix('read_')}"
    assert main(["export", "zoo:field_07", "-o", str(path)]) == 0
    said = capfd.readouterr()
    assert not said.err
    for words in ("(W, 3, 55)", "observation='lidar'", "field_07", "+-10", str(path)):
        assert words in said.out
    act, text = read(path)
    policy, metadata = load_policy("zoo:field_07"), json.loads(text)
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
        actions = act(worlds)
        assert actions.dtype == np.float32
        np.testing.assert_allclose(actions, policy.act(worlds), rtol=0, atol=1e-5)
    assert np.abs(policy.act(seen)).max() == 1.0  # some are clipped


@pytest.mark.parametrize("actor", ["decentralized", "centralized"])
@pytest.mark.parametrize("sharing", ["full", "none"])
@pytest.mark.parametrize("updates", [0, 1])
def test_the_arrays_of_every_team_act_as_it_does(
    sharing: Sharing, actor: Actor, updates: int
) -> None:
    torch.manual_seed(0)
    network = GaussianPolicy(TeamShape(4, 3, (8, 8), sharing, actor))
    torch.nn.init.normal_(network.mean.weights[-1])
    for _ in range(updates):
        network.norm.statistics.update(torch.randn(100, 3, 4) * 3.0 + 1.0)
    policy = TeamPolicy(network)
    seen = np.random.default_rng(0).normal(size=(6, 3, 4)).astype(np.float32)
    expected = np.clip(policy.act(seen, deterministic=True), -1, 1)
    actions = run_arrays(policy.layers().arrays(), seen)
    np.testing.assert_allclose(actions, expected, rtol=0, atol=1e-6)
    assert len(np.unique(actions)) > 10


@pytest.mark.parametrize("n", [1, 4])
@pytest.mark.parametrize("assignment", [False, True])
@pytest.mark.parametrize("dynamics", ["point_mass", "unicycle"])
def test_the_arrays_of_a_network_over_sets_act_as_it_does(
    dynamics: str, assignment: bool, n: int
) -> None:
    settings: dict[str, Any] = {"dynamics": dynamics, "assignment": assignment}
    engine = BatchEngine("field_03", 1, n_robots=4, random_starts=True, **SETS, **settings)
    tokens = Tokens.of(engine.observation_table)
    torch.manual_seed(0)
    network = GaussianPolicy(TeamShape(engine.obs_size, n, (8, 12), "full", tokens=tokens))
    assert isinstance(network.mean, SetActor)
    torch.nn.init.normal_(network.mean.head.weight)
    policy = TeamPolicy(network)
    size = len(tokens.own) + (n - 1) * len(tokens.robot) + 3 * len(tokens.roi)  # of any team
    random = np.random.default_rng(0)
    seen = random.uniform(-1.0, 1.0, (30, n, size)).astype(np.float32)
    seen[random.random(seen.shape) < 0.3] = 0.0
    seen[random.random((30, n)) < 0.3] = 0.0  # absent robots
    expected = np.clip(policy.act(seen, deterministic=True), -1, 1)
    actions = run_arrays(policy.layers().arrays(), seen)
    assert actions.dtype == np.float32
    np.testing.assert_allclose(actions, expected, rtol=0, atol=1e-5)
    assert len(np.unique(actions)) > 10 and (actions == 0).all(-1).any()


@pytest.mark.parametrize("read", [read_onnx, read_pt2, read_npz])
@pytest.mark.parametrize("name", ["zoo:generalist", "zoo:generalist-hint"])
def test_a_policy_for_any_field_is_exported_for_the_sizes_of_one(
    name: str, read: Read, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / f"policy.{read.__name__.removeprefix('read_')}"
    export = ["export", name, "-o", str(path)]
    assert main([*export, "--field", "field_03"]) == 0
    assert "observation='entities'" in capfd.readouterr().out
    act, _ = read(path)
    policy = load_policy(name, "field_03")
    engine = BatchEngine("field_03", 5, **{**policy.settings, "random_starts": True})
    seen = engine.reset(seed=1)
    np.testing.assert_allclose(act(seen), policy.act(seen), rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("algorithm", "kind", "arguments"),
    [
        ("ppo", "MlpPolicy", {"net_arch": [8, 8]}),
        ("ars", "MlpPolicy", {"net_arch": [8]}),
        ("ars", "LinearPolicy", {}),
        ("tqc", "MlpPolicy", {"net_arch": [8, 8]}),
        ("crossq", "MlpPolicy", {"net_arch": [8, 8]}),
    ],
)
@pytest.mark.parametrize("normalized", [False, True])
def test_the_arrays_of_stable_baselines_act_as_it_does(
    algorithm: str, kind: str, arguments: dict[str, Any], normalized: bool
) -> None:
    torch.manual_seed(0)
    network = make_network(algorithm, kind, **arguments)
    for module in network.modules():
        if isinstance(module, BatchRenorm):  # as after a training
            for tensor in (module.ra_mean, module.scale.data, module.bias.data):
                tensor.normal_()
            module.ra_var.uniform_(0.5, 2.0)
    random = np.random.default_rng(0)
    mean, variance = random.normal(size=13) * 300.0, random.uniform(1e-9, 9.0, 13)
    normalization = Normalization(mean, variance, 5.0, 1e-8, 2.0) if normalized else None
    shape = {"algorithm": algorithm, "obs_size": 13, "action_shape": [3, 2], **STATE}
    policy = SB3Policy(network, shape, normalization)
    seen = (mean + 3.0 * random.normal(size=(6, 13))).astype(np.float32)
    seen = seen if normalized else seen / 300.0
    expected = np.clip(policy.act(seen, deterministic=True), -1, 1)
    actions = run_arrays(policy.layers().arrays(), seen)
    assert actions.shape == (6, 3, 2) and actions.dtype == np.float32
    np.testing.assert_allclose(actions, expected, rtol=0, atol=1e-5)
    assert len(np.unique(actions)) > 10


STATE = {"observes": "state"}


def make_network(algorithm: str, kind: str, **arguments: Any) -> Any:
    """A fresh policy of Stable-Baselines3 for three robots on the paper's state."""
    bounds = spaces.Box(-np.inf, np.inf, (13,), np.float32), spaces.Box(-1, 1, (3, 2), np.float32)
    rate = {} if algorithm == "ars" else {"lr_schedule": ConstantSchedule(0.0)}
    return algorithm_class(algorithm).policy_aliases[kind](*bounds, **rate, **arguments)


def test_onnx_takes_the_state(tmp_path: Path) -> None:
    torch.manual_seed(0)
    field = load_field("field_03")
    network = make_network("ppo", "MlpPolicy", net_arch=[8])
    normalization = Normalization(np.full(13, 60.0), np.full(13, 900.0), 5.0, 1e-8, 10.0)
    shape = {"algorithm": "ppo", "obs_size": 13, "action_shape": [3, 2], **STATE}
    policy = LoadedPolicy("mine", SB3Policy(network, shape, normalization), {}, field)
    metadata, _ = export_policy(policy, tmp_path / "policy.onnx")
    assert (metadata["takes"], metadata["shape"]) == ("state", ["W", 13])
    engine = BatchEngine(field, 3, random_starts=True)
    engine.reset(seed=0)
    session = onnxruntime.InferenceSession(tmp_path / "policy.onnx")
    (actions,) = session.run(["actions"], {"state": engine.state()})
    np.testing.assert_allclose(actions, policy.act(engine.state()), rtol=0, atol=1e-5)


def test_rows_that_are_not_clipped_are_normalised() -> None:
    mean, scale = np.full((1, 1, 2), 3.0), np.full((1, 1, 2), 2.0)
    network = np.full((1, 2, 2), 0.25, np.float32), np.zeros((1, 1, 2), np.float32)
    layers = Layers(mean, scale, np.inf, (network[0],), (network[1],), ("tanh",))
    seen = np.array([[[5.0, 9.0]]], np.float32)
    assert run_arrays(layers.arrays(), seen) == pytest.approx(np.tanh(1.0))
    assert Network(layers)(torch.from_numpy(seen)).numpy() == pytest.approx(np.tanh(1.0))


def test_a_network_with_other_parts_is_refused() -> None:
    network = make_network("ppo", "MlpPolicy", activation_fn=torch.nn.ELU)
    assert isinstance(network, ActorCriticPolicy)
    with pytest.raises(ConfigError, match=r"network: has ELU; allowed: Linear, .*Tanh, ReLU"):
        layers_of(network, np.zeros(13), np.ones(13), 10.0)


def test_a_teams_own_network_can_be_exported_by_torch() -> None:
    class Means(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.network = GaussianPolicy(TeamShape(4, 3, (8,), "full"))

        def forward(self, seen: torch.Tensor) -> torch.Tensor:
            return self.network.means(self.network.norm.normalize(seen))

    module, seen = Means(), torch.randn(5, 3, 4)
    program = torch.export.export(module, (seen,))
    assert torch.allclose(program.module()(seen), module(seen), atol=1e-6)


def test_what_cannot_be_exported_is_named(
    refusal: Refusal, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for name in ("greedy", "zoo", "module:own"):
        told = refusal(["export", name, "-o", "policy.npz"])
        assert f"{name}: has no network; allowed: zoo:NAME and the folders" in told
    assert "policy.pt: unknown ending" in refusal(["export", "greedy", "-o", "policy.pt"])
    assert "did you mean greedy" in refusal(["export", "gredy", "-o", "policy.npz"])
    told = refusal(["export", "zoo:generalist", "-o", "policy.npz"])
    assert "field: needed, for example: mbn export zoo:generalist --field field_03 -o" in told
    zoo = ["export", "zoo:field_07", "-o"]
    assert "field: zoo:field_07 has its own" in refusal([*zoo, "a.npz", "--field", "field_03"])
    assert "policy.pt: unknown ending" in (told := refusal([*zoo, "policy.pt"]))
    assert ".onnx, .pt2, .npz" in told
    Path("policy.npz").touch()
    assert "policy.npz already exists" in refusal([*zoo, "policy.npz"])
    for package in ("onnxruntime", "onnxscript"):
        with monkeypatch.context() as patch:
            patch.setitem(sys.modules, package, None)
            told = refusal([*zoo, "policy.onnx"])
        assert package in told and "pip install 'mbn_marl[export]' brings it" in told


def test_a_file_that_acts_otherwise_is_not_written(
    refusal: Refusal, monkeypatch: pytest.MonkeyPatch
) -> None:
    true = LoadedPolicy.act
    monkeypatch.setattr(LoadedPolicy, "act", lambda self, seen: true(self, seen) + 2e-4)
    assert "not written" in refusal(["export", "zoo:field_07", "-o", "policy.npz"])
    assert not Path("policy.npz").exists()
