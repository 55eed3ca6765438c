"""``mbn grid``: many runs, declared in a file, on this machine or on a cluster."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from baselines.cli.options import CORES, OptionalOutput, check_options

if TYPE_CHECKING:
    from baselines.sweep.run import Sweep

ACTIONS = ("status", "fetch")


@dataclass(frozen=True)
class Grid:
    """Train a grid of runs that a YAML file declares, see docs/grid.md.

    Finished runs are never made again, failed and interrupted ones resume from their last
    checkpoint. `mbn grid status SPEC` shows the progress, from any machine that sees the store;
    `mbn grid fetch SPEC` copies the finished runs of a remote store to --out.
    """

    words: Positional[Annotated[tuple[str, ...], arg(metavar="[status|fetch] SPEC")]]
    """The YAML file, after what to do with it if not to train."""
    engine: Literal["local", "ray"] = "local"
    """local: processes of this machine. ray: a Ray cluster that is there already."""
    processes: int = CORES
    """local: runs at a time; each takes one core."""
    address: str | None = None
    """ray: HOST:PORT of the cluster; by default $RAY_ADDRESS, or the cluster this machine is in."""
    check: bool = False
    """Check the file and say what there is to do, but do nothing."""
    out: OptionalOutput = None
    """fetch: the folder that the runs are copied into."""

    def run(self, command_line: str) -> None:
        """Do what is asked."""
        from baselines.sweep.run import Sweep
        from baselines.sweep.spec import read_spec

        named = bool(self.words) and self.words[0] in ACTIONS
        action, *rest = self.words if named else ("train", *self.words)
        wrong = {
            f"SPEC: one file is needed, not {len(rest)}": len(rest) != 1,
            f"processes: at least 1, not {self.processes}": self.processes < 1,
            "address: allowed with --engine ray": self.address and self.engine != "ray",
            "out: needed by fetch, and allowed there alone": (action == "fetch")
            != (self.out is not None),
        }
        check_options("grid", wrong)
        sweep = Sweep.of(read_spec(Path(rest[0])))
        {"status": self._watch, "fetch": self._fetch, "train": self._train}[action](sweep)

    def _train(self, sweep: Sweep) -> None:
        from baselines.console import console
        from baselines.sweep.run import make_engine
        from baselines.sweep.status import live
        from baselines.sweep.worker import Outcome

        screen = console()
        done = len(sweep.runs) - len(sweep.left())
        print(f"{len(sweep.runs)} runs, {done} of them done; {sweep.place}", flush=True)
        if self.check:
            return

        def tell(outcome: Outcome) -> None:
            if not screen.is_terminal:
                error = "" if outcome.error is None else f" ({outcome.error})"
                print(f"{outcome.name}: {outcome.state}{error}", flush=True)

        engine = make_engine(self.engine, self.processes, self.address, sweep.resources)
        with live(sweep, screen):
            sweep.train(engine, tell)

    def _watch(self, sweep: Sweep) -> None:
        import time

        from baselines.console import console
        from baselines.sweep.status import Status, live, show

        screen = console()
        if not screen.is_terminal:
            screen.print(show(Status.of(sweep)), soft_wrap=True, highlight=False)
            return
        with live(sweep, screen):
            while Status.of(sweep).count("done") < len(sweep.runs):
                time.sleep(sweep.store.refresh)

    def _fetch(self, sweep: Sweep) -> None:
        from baselines.sweep.store import RemoteStore
        from mbn_marl.errors import ConfigError

        assert self.out is not None
        if not isinstance(sweep.store, RemoteStore):
            raise ConfigError("grid", [f"store: {sweep.place} is here already; nothing to fetch"])
        names = sorted(sweep.store.finished(sweep.names))
        for name in names:
            sweep.store.fetch(name, self.out / name)
        print(f"{len(names)} of {len(sweep.runs)} runs are finished and in {self.out}")
