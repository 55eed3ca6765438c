"""``mbn warmup``: compile the engine before it is needed."""

from __future__ import annotations

import time
from dataclasses import dataclass

from mbn_marl.config import Condition, Observation


@dataclass(frozen=True)
class Warmup:
    """Compile the engine ahead of its first use, as for the image of a cluster's machines.

    What is compiled lies in NUMBA_CACHE_DIR, or beside the sources: keep that folder.
    """

    observation: tuple[Observation, ...] = ("relative",)
    """The kinds of observation to compile for."""
    condition: tuple[Condition, ...] = ("calm",)
    """The named conditions to compile for."""

    def run(self, command_line: str) -> None:
        """Use all that an engine on the CPU offers, once for each kind of configuration."""
        from mbn_marl import BatchEngine

        for observation in self.observation:
            for condition in self.condition:
                start = time.perf_counter()
                for threads in (1, 2):
                    engine = BatchEngine(
                        *("field_03", 2),
                        threads=threads,
                        autoreset="disabled",
                        observation=observation,
                        condition=condition,
                        max_steps=1,
                    )
                    engine.reset(seed=0)
                    engine.step(engine.sample_actions())
                engine.reset_worlds([True, False])
                engine.step(engine.sample_actions(), [True, False])
                engine.state()
                engine.metrics()
                seconds = time.perf_counter() - start
                print(f"{observation}, {condition}: {seconds:.1f} s")
