"""Work on a Ray cluster: placement, retries and lost machines are Ray's business."""

from __future__ import annotations

import logging
import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal

from baselines.sweep.processes import Failed, Work, stop_all
from mbn_marl.errors import MbnError

Engine = Literal["local", "ray"]
"""What does the work: processes of this machine, or a Ray cluster."""


@dataclass(frozen=True)
class Needs:
    """What Ray is asked to give a job.

    Attributes:
        cpus: cores that it takes (>= 0).
        gpus: GPUs that it takes (>= 0), whole or a share of one.
        retries: how often it is begun again when its process or its machine is lost (>= 0).
        retry_errors: whether it is begun again after an exception too.
    """

    cpus: float = 1.0
    gpus: float = 0.0
    retries: int = 3
    retry_errors: bool = False


@contextmanager
def connected(address: str | None) -> Iterator[None]:
    """Use the Ray cluster at ``address``; ``None`` for that of ``RAY_ADDRESS`` or this machine.

    A connection that this process has already is taken, and kept.

    Raises:
        MbnError: there is no cluster, or it runs another Ray or Python.
    """
    import ray

    if ray.is_initialized():
        yield
        return
    try:
        if address is not None:
            _reach(address)
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


def _reach(address: str) -> None:
    """Whether somebody listens at HOST:PORT; Ray itself would try for minutes.

    Raises:
        OSError: nobody does.
        ValueError: it is no such address.
    """
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not host or not port.isdecimal():
        raise ValueError("the address must be HOST:PORT")
    with socket.create_connection((host, int(port)), timeout=10.0):
        pass


def work_on_ray(
    work: Work,
    jobs: Sequence[Any],
    listener: Callable[[Any], None],
    needs: Needs,
    *,
    failed: Failed = stop_all,
    after: Sequence[int | None] = (),
) -> None:
    """Do all jobs as tasks of the connected Ray cluster, each in a process of its own.

    Args:
        work: does one job.
        jobs: can be pickled.
        listener: is told here what a job reported last, when it has ended.
        needs: of every job.
        failed: is told of a job that failed for good; by default the first one stops all.
        after: for each job the place of an earlier one that has to end before it begins, or
            ``None``.

    Raises:
        RunError: by default, when a job failed.
    """
    import ray

    task = ray.remote(_do).options(
        num_cpus=needs.cpus,
        num_gpus=needs.gpus,
        max_retries=needs.retries,
        retry_exceptions=needs.retry_errors,
    )
    places: dict[Any, int] = {}
    refs: list[Any] = []
    for place, (job, before) in enumerate(zip(jobs, after or [None] * len(jobs), strict=True)):
        refs.append(task.remote(work, job, [] if before is None else refs[before]))
        places[refs[-1]] = place
    waiting = list(refs)
    try:
        while waiting:
            ended, waiting = ray.wait(waiting)
            for ref in ended:
                try:
                    messages = ray.get(ref)
                except ray.exceptions.RayError as error:
                    failed(places[ref], _words(error))
                else:
                    for message in messages:
                        listener(message)
    finally:
        for ref in waiting:
            ray.cancel(ref, force=True)


def enough_somewhere(needs: Needs) -> bool:
    """Whether a machine that the cluster has now can give a job what it needs."""
    import ray

    return any(
        node["Alive"]
        and node["Resources"].get("CPU", 0.0) >= needs.cpus
        and node["Resources"].get("GPU", 0.0) >= needs.gpus
        for node in ray.nodes()
    )


def _do(work: Work, job: Any, before: Any) -> list[Any]:
    """Do a job here, on some machine; its last report, if it made one."""
    messages: list[Any] = []

    def keep_the_last(message: Any) -> None:
        messages[:] = [message]

    work(job, keep_the_last)
    return messages


def _words(error: Exception) -> str:
    """What went wrong: the error of the job itself, or what Ray says of its process or machine."""
    cause = getattr(error, "cause", None)
    return str(error if cause is None else cause)
