"""The CUDA backend in Numba's simulator, where kernels are Python and threads are Python's."""

import copy
import threading
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from numba.cuda.simulator.kernel import BlockThread
from numba.cuda.simulator.kernelapi import FakeCUDAShared
from numpy.typing import NDArray

from mbn_marl import BatchEngine, Failures, Uniform
from mbn_marl.engine import cuda, cuda_kernels
from mbn_marl.errors import ActionError, ConfigError, StepError
from mbn_marl.field import FieldSampler
from mbn_marl.field.generator.layout import FAMILIES
from tests.engine.test_golden import golden_field
from tests.golden import load_episodes
from tests.support.worlds import ASSIGNED, KINDS, OWN

SPREAD = sorted(load_episodes(), key=lambda episode: len(episode.actions))[::18]
WORLDS = 3  # with two threads in a block: the last block is not full
# No test has one world or one robot alone: strides of other kinds would be other types to compile.
MIXED = ("bicycle", "point_mass", "unicycle")
SETTINGS: dict[str, Any] = {"random_starts": True, "max_steps": 40, "wind": (0.05, 40.0)}


class SimulatedDevice:
    torch = torch.device("cpu")

    def array(self, tensor: Any) -> NDArray[Any]:
        return tensor.numpy()

    def is_capturing(self) -> bool:
        return False

    def launch(self, kernel: Any, blocks: int, threads: int, *arguments: Any) -> None:
        kernel[blocks, threads](*arguments)


def is_alive_after_a_moment(thread: threading.Thread) -> bool:
    """The simulator polls its threads, and would take more time for that than they for the work."""
    thread.join(1e-4)
    return threading.Thread.is_alive(thread)


@pytest.fixture(autouse=True)
def simulator(monkeypatch):
    monkeypatch.setattr(cuda, "Device", SimulatedDevice)
    monkeypatch.setattr(cuda_kernels, "MOST_THREADS", 2)
    allocate, lock = FakeCUDAShared.array, threading.Lock()

    def allocate_once(*arguments: Any) -> Any:
        """The simulator's own would give two threads that ask at once an array each.

        It tells arrays apart by the line that asks, now this one: a kernel may have one.
        """
        with lock:
            return allocate(*arguments)

    monkeypatch.setattr(FakeCUDAShared, "array", allocate_once)
    monkeypatch.setattr(BlockThread, "is_alive", is_alive_after_a_moment)


def pair(field: Any = "field_03", **settings: Any) -> tuple[BatchEngine, BatchEngine]:
    return (
        BatchEngine(field, WORLDS, seed=11, threads=1, **settings),
        BatchEngine(field, WORLDS, seed=11, device="cuda", **settings),
    )


def assert_same(cpu: BatchEngine, gpu: BatchEngine) -> None:
    """Everything that the engines tell, bit for bit."""
    outputs = ("observations", "rewards", "terminated", "truncated")
    engines = (cpu, gpu)
    told = {
        **{name: [getattr(one._backend.output, name) for one in engines] for name in outputs},
        **{name: [getattr(one, name)() for one in engines] for name in ("state", "infos")},
        "reward_terms": [one.reward_terms() for one in engines],
        "team_rewards": [one.team_rewards for one in engines],
        **{name: (drawn, gpu.drawn()[name]) for name, drawn in cpu.drawn().items()},
    }
    theirs = gpu.metrics()
    told |= {name: (value, theirs[name]) for name, value in cpu.metrics().items()}
    if cpu.autoreset == "same_step":
        ended = cpu._backend.output.terminated | cpu._backend.output.truncated
        rows = (ended, torch.from_numpy(ended))
        finals = [(one.final_observations, one.final_state()) for one in engines]
        for k, name in enumerate(("final observations", "final state")):
            told[name] = [final[k][row] for final, row in zip(finals, rows, strict=True)]
    for name, (expected, tensor) in told.items():
        assert isinstance(tensor, torch.Tensor), name
        got = tensor.numpy()
        assert got.dtype == expected.dtype, name
        np.testing.assert_array_equal(got, expected, name)


def run(cpu: BatchEngine, gpu: BatchEngine, steps: int) -> int:
    ended = 0
    np.testing.assert_array_equal(gpu.reset().numpy(), cpu.reset())
    for _ in range(steps):
        actions = cpu.sample_actions()
        np.testing.assert_array_equal(gpu.sample_actions().numpy(), actions)
        _, _, terminated, truncated = cpu.step(actions)
        gpu.step(torch.from_numpy(actions))
        ended += int((terminated | truncated).sum())
        assert_same(cpu, gpu)
    return ended


@pytest.mark.parametrize("autoreset", ["same_step", "next_step"])
def test_equals_the_cpu_through_resets(autoreset):
    assert run(*pair(autoreset=autoreset, **SETTINGS), steps=200) >= 10


BLOWN: dict[str, Any] = {
    **{"gust": 0.1, "failures": Failures(between=(3, 9)), "dynamics": "mixed"},
    **{"mass": Uniform(0.5, 2.0), "tau": Uniform(0.8, 1.2)},
    "wind": (Uniform(0.1, 0.25), Uniform(0.0, 360.0)),
}
HARD: dict[str, Any] = {
    **{"gust": 0.1, "action_noise": 0.1, "action_loss": 0.3, "action_delay": 2},
    **{"position_noise": 1.0, "velocity_noise": 0.1, "dropout": 0.2},
    "field": ["field_05", "field_09"],
}
LARGE = FieldSampler(FAMILIES, robots=(2, 4), rois=(2, 8))
# Each set of features is a program to compile, so there are few.
CASES: dict[str, dict[str, Any]] = {
    "local": {"observation": "local", "one_hot": True, "field": KINDS},
    "formal": {"reward": "formal", "observation": "state", "n_robots": 2},
    "team": {"reward_sharing": "team", "mass": (1.0, 1.5, 2.0), "f_max": 3.0},
    "features, coasting": {
        **{"observation": "lidar_local", **HARD},
        **{"dynamics": ("holonomic", "unicycle", "bicycle"), "f_max": (1.0, 2.0, 3.0)},
        "failures": {"rate": 0.05, "at": {2: 9}, "most": 3, "kind": "coast"},
    },
    "features, vanishing": {
        **{"observation": "lidar", "reward": "formal", **HARD},
        **{"dynamics": MIXED, "failures": {"rate": 0.05, "kind": "vanish"}},
    },
    "features, own": {
        **{"observation": "entities", "hidden_rois": True, **OWN, "comm_radius": 90.0},
        **{"failures": {"rate": 0.02, "kind": "vanish"}, "roi_radius": 40.0},
    },
    "random_fields, state": {"field": LARGE, "observation": "state", **BLOWN},
    "random_fields, relative": {"field": FieldSampler(robots=(2, 3)), **BLOWN},
    "random_fields, entities": {
        **{"field": FieldSampler(FAMILIES, robots=(2, 4)), "dropout": 0.2, **ASSIGNED}
    },
}


@pytest.mark.parametrize("case", CASES)
def test_equals_the_cpu(case):
    run(*pair(**(SETTINGS | CASES[case])), steps=60)


@pytest.mark.parametrize("episode", SPREAD, ids=lambda episode: episode.id)
def test_golden_episode(episode):
    field = golden_field(episode.field)
    engine = BatchEngine(
        field, 2, device="cuda", n_robots=episode.n_robots, wind=episode.wind, autoreset=False
    )
    engine.reset()
    for t, actions in enumerate(episode.actions):
        _, _, terminated, truncated = engine.step(torch.from_numpy(np.stack([actions, actions])))
        assert float(engine.team_rewards[0]) == episode.rewards[t]
        assert bool(terminated[0]) == episode.terminated[t]
        assert bool(truncated[0]) == (t == 999 and not episode.terminated[t])
    state, n = engine.state()[0].numpy(), episode.n_robots
    np.testing.assert_allclose(state[: 2 * n], episode.positions[-1].ravel(), rtol=0, atol=0.005)
    assert state[4 * n] == episode.codes[-1]


def test_worlds_that_have_ended_wait_for_their_reset():
    cpu, gpu = pair(autoreset="disabled", **SETTINGS)
    run_on = np.array([True, True, True])
    cpu.reset(), gpu.reset()
    resets = 0
    for _ in range(130):
        actions = cpu.sample_actions()
        assert (gpu.sample_actions().numpy() == actions).all()
        _, _, terminated, truncated = cpu.step(actions, run_on)
        gpu.step(torch.from_numpy(actions), torch.from_numpy(run_on))
        assert_same(cpu, gpu)
        run_on = run_on & ~(terminated | truncated)
        if run_on.sum() <= 1:
            resets += int((~run_on).sum())
            again = cpu.reset_worlds(~run_on)
            assert (gpu.reset_worlds(torch.from_numpy(~run_on)).numpy() == again).all()
            assert_same(cpu, gpu)
            run_on = np.array([True, True, True])
    assert resets >= 4


def test_a_fault_rests_its_world_and_is_raised_at_the_next_reset():
    _, gpu = pair(autoreset="disabled", **SETTINGS)
    with pytest.raises(StepError, match="world 0 was never reset"):
        gpu.step(torch.zeros(WORLDS, 3, 2))
        gpu.reset()
    gpu.reset()
    before = gpu.state()
    actions = torch.ones(WORLDS, 3, 2)
    actions[1, 2, 0] = torch.nan
    actions[2, 0, 1] = torch.inf
    _, rewards, terminated, truncated = gpu.step(actions.double())
    moved = (gpu.state() != before).any(dim=1)
    assert moved.tolist() == [True, False, False]
    assert not rewards[1:].any() and not (terminated | truncated).any()
    with pytest.raises(ActionError, match=r"actions\[1\] .* not finite"):
        gpu.snapshot()
    assert gpu.snapshot(0).step == 1
    assert gpu.snapshot(1).step == 0
    gpu.step(torch.ones(WORLDS, 3, 2), torch.tensor([True, True, False]))
    with pytest.raises(StepError, match="world 2 is left out"):
        gpu.reset_worlds(torch.ones(WORLDS, dtype=torch.bool))


@pytest.mark.parametrize(
    ("actions", "problem"),
    [
        (np.zeros((WORLDS, 3, 2)), "actions: ndarray; allowed: a torch tensor on cpu"),
        (torch.zeros(WORLDS, 2, 3), r"actions: shape \(3, 2, 3\); allowed: \(3, 3, 2\)"),
        (torch.zeros(WORLDS, 3, 2, dtype=torch.bool), "actions: dtype torch.bool"),
    ],
)
def test_shapes_and_types_are_checked_at_once(actions, problem):
    _, gpu = pair()
    gpu.reset()
    with pytest.raises(ActionError, match=problem):
        gpu.step(actions)
    with pytest.raises(ActionError, match=r"mask: shape \(2,\)"):
        gpu.reset_worlds(torch.ones(2, dtype=torch.bool))


def test_outputs_are_written_in_place_and_copies_and_saved_worlds_go_on_alike():
    _, gpu = pair(**SETTINGS)
    _, other = pair(**SETTINGS)
    first = gpu.reset()
    for _ in range(20):
        assert gpu.step(gpu.sample_actions())[0] is first
    other.reset(99)
    other.step(torch.full((WORLDS, 3, 2), torch.nan))  # of worlds that are replaced
    other.load_state(gpu.save_state())
    other.snapshot()
    twin = copy.deepcopy(gpu)
    for _ in range(30):
        actions = gpu.sample_actions()
        ahead = [tensor.clone() for tensor in gpu.step(actions)]
        for engine in (twin, other):
            assert (engine.sample_actions() == actions).all()
            assert all((a == b).all() for a, b in zip(ahead, engine.step(actions), strict=True))
    assert twin.step(actions)[0] is not first


def test_snapshot():
    cpu, gpu = pair(**SETTINGS)
    run(cpu, gpu, 10)
    expected, got = vars(cpu.snapshot(1)), vars(gpu.snapshot(1))
    assert expected.keys() == got.keys()
    for name in expected.keys() - {"field"}:
        np.testing.assert_array_equal(got[name], expected[name], name)


def test_torchrl_environment(monkeypatch):
    from mbn_marl.adapters import torchrl

    made = []
    for device in ("cpu", "cuda"):
        engine = partial(BatchEngine, seed=3)
        monkeypatch.setattr(
            torchrl,
            "BatchEngine",
            lambda *a, engine=engine, d=device, **k: engine(*a, **k | {"device": d}),
        )
        env = torchrl.NavigationEnv("field_03", WORLDS, seed=3, **SETTINGS)
        torch.manual_seed(0)
        made.append(env.rollout(60, break_when_any_done=False))
        assert env.engine.device == device
    assert made[0]["next", "done"].any()
    assert (made[0] == made[1]).all()


def test_the_simulator_is_no_gpu(monkeypatch):
    monkeypatch.undo()
    with pytest.raises(ConfigError, match=r"an NVIDIA GPU.*\[cuda\].*CUDASIM"):
        BatchEngine("field_03", 2, device="cuda")


def test_recorders_note_the_same():
    from mbn_marl.episode import EpisodeRecorder

    cpu, gpu = pair(**{**SETTINGS, "max_steps": 3})
    with EpisodeRecorder(cpu, 1) as ours, EpisodeRecorder(gpu, 1) as theirs:
        for engine in (cpu, gpu):
            engine.reset(5)
        for _ in range(8):
            actions = cpu.sample_actions()
            cpu.step(actions)
            gpu.step(torch.from_numpy(actions.copy()))
            assert cpu.running.all() and gpu.running.all()
    assert cpu.seed == gpu.seed == 5
    assert len(ours._tapes) == len(theirs._tapes) >= 3
    for tape, other in zip(ours._tapes, theirs._tapes, strict=True):
        assert np.array_equal(tape.starts, other.starts) and tape.rewards == other.rewards
        assert np.array_equal(tape.actions, other.actions)
