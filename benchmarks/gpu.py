"""The speed of ``BatchEngine(device="cuda")``, once it equals the CPU bit for bit."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch

from baselines.compare.text_table import TextTable
from benchmarks.report import Benchmark, Findings, Measurement, measurement_table, number
from mbn_marl import BatchEngine
from mbn_marl.errors import MbnError

COPY_BYTES = 2**30
TARGET_RATE, TARGET_RATIO = 2000.0, 0.5
GRAPH_STEPS = 16  # each with other random actions


@dataclass(frozen=True)
class Gpu(Benchmark):
    """Check the engine on CUDA against the CPU's, and measure how fast it steps."""

    name: ClassVar[str] = "gpu"

    field: str = "field_01"
    """The catalogue's field."""
    least: int = 12
    """log2 of the smallest batch."""
    most: int = 20
    """log2 of the largest batch; 20 needs about 40 GB on the device."""
    steps: int = 512
    """Timed steps, after as many that bring the worlds out of step."""
    check_steps: int = 300
    """Steps that are compared with the CPU's."""

    def measure(self) -> Findings:
        check_against_the_cpu(self)
        copy = copy_rate()
        sizes: list[dict[str, float]] = []
        note = f"all sizes up to {2**self.most} worlds fit into the device's memory"
        for power in range(self.least, self.most + 1):
            try:
                sizes.append(measure(self, 2**power, copy))
            except torch.cuda.OutOfMemoryError:
                note = f"{2**power} worlds do not fit into the device's memory"
                break
            torch.cuda.empty_cache()
        best = max(size["graph_rate"] for size in sizes)
        ratio = max(size["ratio_to_copy"] for size in sizes)
        rows = [
            Measurement("steps of a CUDA graph", best / 1e6, "M env-steps/s", TARGET_RATE),
            Measurement("necessary bytes, of a copy's rate", ratio, "", TARGET_RATIO),
            Measurement("copy, read and written", copy / 1e9, "GB/s"),
        ]
        device = torch.cuda.get_device_name()
        equal = f"equal to the CPU over {self.check_steps} steps of {2**self.least} worlds"
        lines = tuple(tuple(map(number, size.values())) for size in sizes)
        headings = ("worlds", "eager, env-steps/s", "graph, env-steps/s", "GB/s", "of a copy")
        tables = {
            f"{device}, {self.field}, random actions": measurement_table(rows, equal),
            "batch sizes": TextTable(note, headings, lines),
        }
        values = {"rows": [row.to_json() for row in rows], "device": device, "sizes": sizes}
        return Findings(tables, values)


def seconds(work: Callable[[], object], times: int) -> float:
    """Return the device's seconds, the best of three rounds after a first."""
    work()
    new_event: Any = torch.cuda.Event  # its constructor has no types
    best = float("inf")
    for _ in range(3):
        start, end = (new_event(enable_timing=True) for _ in range(2))
        start.record()
        for _ in range(times):
            work()
        end.record()
        end.synchronize()
        best = min(best, float(start.elapsed_time(end)) / 1e3)
    return best


def copy_rate() -> float:
    """Return bytes per second, read and written, of a copy on the device."""
    source = torch.zeros(COPY_BYTES, dtype=torch.uint8, device="cuda")
    target = torch.empty_like(source)
    return 2 * COPY_BYTES * 20 / seconds(lambda: target.copy_(source), 20)


def necessary_bytes(engine: BatchEngine) -> int:
    """Return the bytes that a step has to read and write for one world.

    State and filter words are read and written, actions read, outputs and trail entries written.
    """
    backend, worlds, n = engine._backend, engine.num_worlds, engine.n_robots
    out = backend.output
    changed = sum(array.nbytes for array in backend.now)
    written = sum(array.nbytes for array in out) - out.final_observations.nbytes
    actions = trail = 2 * n * engine.dtype.itemsize
    filters, words, pending = 2 * 8 * n, 8, 1
    return int((2 * changed + written) / worlds) + actions + trail + filters + words + pending


def check_against_the_cpu(options: Gpu) -> None:
    """Step both engines alike; every output has to be the same, bit for bit."""
    settings: dict[str, Any] = {"num_worlds": 2**options.least, "seed": 3, "random_starts": True}
    wanted: tuple[Any, ...]
    found: tuple[Any, ...]
    cpu = BatchEngine(options.field, **settings)
    gpu = BatchEngine(options.field, device="cuda", **settings)
    names = ("observations", "rewards", "terminated", "truncated", "team rewards", "state")
    wanted, found = (cpu.reset(),), (gpu.reset(),)
    for t in range(options.check_steps + 1):
        for name, one, other in zip(names, wanted, found, strict=False):
            if not np.array_equal(torch.as_tensor(other).cpu().numpy(), one):
                raise MbnError(f"step {t}: {name} differ from the CPU's; nothing was measured")
        actions = cpu.sample_actions()
        wanted = *cpu.step(actions), cpu.team_rewards, cpu.state()
        found = *gpu.step(torch.from_numpy(actions).cuda()), gpu.team_rewards, gpu.state()


def measure(options: Gpu, worlds: int, copy: float) -> dict[str, float]:
    """Step one batch size, launch by launch and as a graph; rates are in env-steps/s."""
    engine = BatchEngine(options.field, worlds, device="cuda")
    engine.reset()
    actions = [engine.sample_actions() for _ in range(GRAPH_STEPS)]

    def some_steps() -> None:
        for one in actions:
            engine.step(one)

    rounds = -(-options.steps // GRAPH_STEPS)
    for _ in range(rounds):
        some_steps()
    eager = seconds(some_steps, rounds)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        some_steps()
    replayed = seconds(graph.replay, rounds)
    steps = worlds * rounds * GRAPH_STEPS
    rate = steps / replayed
    moved = rate * necessary_bytes(engine)
    return {
        "worlds": worlds,
        "eager_rate": steps / eager,
        "graph_rate": rate,
        "gigabytes_per_second": moved / 1e9,
        "ratio_to_copy": moved / copy,
    }
