"""Run jobs as tasks of a Ray cluster."""

import logging
import socket
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from baselines.sweep.processes import Ended, Failure, Report, Work
from mbn_marl.errors import MbnError


@dataclass(frozen=True)
class RayEngine:
    """Run jobs on a Ray cluster; one is repeated when its machine is lost, or after an error."""

    # HOST:PORT; by default that of ``RAY_ADDRESS``, or of this machine.
    address: str | None = None
    # Of each job: cores, and GPUs or a share of one.
    cpus: float = 1.0
    gpus: float = 0.0
    retries: int = 3

    def run(self, work: Work, jobs: Iterable[Any], report: Report, ended: Ended) -> None:
        import ray

        address = self.address
        try:
            if address is not None:  # Ray would try for minutes
                host, _, port = address.removeprefix("ray://").rpartition(":")
                if not host or not port.isdecimal():
                    raise ValueError("the address must be HOST:PORT")
                socket.create_connection((host, int(port)), timeout=10.0).close()
            ray.init(address=address or "auto", log_to_driver=False, logging_level=logging.ERROR)
        except (OSError, RuntimeError, ValueError) as error:
            place = "here" if address is None else f"at {address}"
            raise MbnError(
                f"no Ray cluster {place} ({str(error).splitlines()[0]}); start one with `ray start "
                "--head`, or name one with --address HOST:PORT"
            ) from None
        try:
            task = ray.remote(_work_in_task).options(
                num_cpus=self.cpus,
                num_gpus=self.gpus,
                max_retries=self.retries,
                retry_exceptions=True,
            )
            running = {task.remote(work, job): job for job in jobs}
            while running:
                for ref in ray.wait(list(running))[0]:
                    try:
                        result = ray.get(ref)
                    except ray.exceptions.RayError as error:
                        result = Failure(str(getattr(error, "cause", None) or error))
                    ended(running.pop(ref), result)
        finally:
            ray.shutdown()  # which ends the tasks that are running


def _work_in_task(work: Work, job: Any) -> Any:
    try:
        return work(job, lambda message: None)
    except MbnError as error:  # a repetition would raise it again
        return Failure(str(error))
