"""Jobs on a Ray cluster: placement, retries and lost machines are Ray's business."""

from __future__ import annotations

import logging
import socket
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from baselines.sweep.processes import Ended, Failure, Job, Work
from mbn_marl.errors import MbnError


@dataclass(frozen=True)
class RayEngine:
    """A Ray cluster that is there already; every job is a task with its own process.

    Attributes:
        address: HOST:PORT; ``None`` for that of ``RAY_ADDRESS``, or the cluster this machine is in.
        cpus: cores that a job takes (>= 0).
        gpus: GPUs that a job takes (>= 0), whole or a share of one.
        retries: how often a job is begun again (>= 0) when its process or machine is lost, or after
            an error other than of bad input.
    """

    address: str | None = None
    cpus: float = 1.0
    gpus: float = 0.0
    retries: int = 3

    def run(
        self, work: Work, jobs: Iterable[Job], report: Callable[[Any], None], ended: Ended
    ) -> None:
        """Do all jobs, see :meth:`LocalEngine.run`; only a job's last report is received."""
        import ray

        with connected(self.address):
            self._warn_if_too_small()
            task = ray.remote(_do).options(
                num_cpus=self.cpus,
                num_gpus=self.gpus,
                max_retries=self.retries,
                retry_exceptions=True,
            )
            refs: dict[str | None, Any] = {None: None}
            running: dict[Any, Job] = {}
            for job in jobs:
                refs[job.name] = task.remote(work, job, refs[job.after])
                running[refs[job.name]] = job
            try:
                while running:
                    for ref in ray.wait(list(running))[0]:
                        messages, result = _result_of(ref)
                        for message in messages:
                            report(message)
                        ended(running.pop(ref), result)
            finally:
                for ref in running:
                    ray.cancel(ref, force=True)

    def _warn_if_too_small(self) -> None:
        """Log a warning if no machine of the cluster has what a job takes."""
        import ray

        wanted = {"CPU": self.cpus, "GPU": self.gpus}
        if not any(
            node["Alive"] and all(node["Resources"].get(one, 0.0) >= n for one, n in wanted.items())
            for node in ray.nodes()
        ):
            logging.getLogger(__name__).warning(
                "no machine of the cluster has %g cores and %g GPUs for a run now; waiting for one",
                self.cpus,
                self.gpus,
            )


def _result_of(ref: Any) -> tuple[list[Any], Any]:
    """Return what :func:`_do` returned, or how it failed."""
    import ray

    try:
        done: tuple[list[Any], Any] = ray.get(ref)
    except ray.exceptions.RayError as error:
        return [], Failure(str(getattr(error, "cause", None) or error))
    return done


@contextmanager
def connected(address: str | None) -> Iterator[None]:
    """Use a Ray cluster, if this process has none; raise an MbnError if it cannot be reached."""
    import ray

    if ray.is_initialized():
        yield
        return
    try:
        if address is not None:  # which Ray itself would try to reach for minutes
            host, _, port = address.removeprefix("ray://").rpartition(":")
            if not host or not port.isdecimal():
                raise ValueError("the address must be HOST:PORT")
            socket.create_connection((host, int(port)), timeout=10.0).close()
        ray.init(address=address or "auto", log_to_driver=False, logging_level=logging.ERROR)
    except (OSError, RuntimeError, ValueError) as error:
        where = "here" if address is None else f"at {address}"
        raise MbnError(
            f"no Ray cluster {where} ({str(error).splitlines()[0]}); start one with `ray start "
            "--head`, or name one with --address HOST:PORT"
        ) from None
    try:
        yield
    finally:
        ray.shutdown()


def _do(work: Work, job: Job, before: Any) -> tuple[list[Any], Any]:
    """Do a job on some machine; return its last report, if it made one, and its result."""
    messages: list[Any] = []

    def keep_the_last(message: Any) -> None:
        messages[:] = [message]

    try:
        result = work(job, keep_the_last)
    except MbnError as error:  # it would come again
        result = Failure(str(error))
    return messages, result
