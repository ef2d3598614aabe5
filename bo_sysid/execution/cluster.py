"""Jobs on a Ray cluster: the same calls, the same outcomes, on as many machines as there are."""

import contextlib
import logging
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from bo_sysid.errors import StudyError
from bo_sysid.execution.jobs import JobOutcome, answer

RETRIES = 3  # of a job whose machine or process was lost
_AHEAD = 2  # jobs handed over for every core of the cluster; the others wait here


@dataclass(frozen=True)
class RayEngine:
    """A Ray cluster, one core a job.

    A job whose machine is lost is run again on another one; its outcome is reported once. The
    package must be installed on every machine, and files that jobs read or write must lie where all
    of them see them.

    Attributes:
        address: of the cluster; "auto" finds a running one, None starts one on this machine.
    """

    address: str | None = "auto"

    def __post_init__(self) -> None:
        _ray()

    def run(self, function: Callable[[Any], Any], jobs: Mapping[str, Any]) -> Iterator[JobOutcome]:
        """Yield the outcome of ``function(job)`` for every job, in the order they end."""
        ray = _ray()
        with _connected(ray, self.address):
            remote = ray.remote(num_cpus=1, max_retries=RETRIES)(answer)
            waiting: deque[tuple[str, Any]] = deque(jobs.items())
            busy: dict[Any, str] = {}
            try:
                while waiting or busy:
                    room = _AHEAD * max(int(ray.cluster_resources().get("CPU", 1)), 1)
                    while waiting and len(busy) < room:
                        key, job = waiting.popleft()
                        busy[remote.remote(function, job)] = key
                    (ended,), _ = ray.wait(list(busy), num_returns=1)
                    yield job_outcome(ray, busy.pop(ended), ended)
            finally:
                for reference in busy:
                    ray.cancel(reference, force=True)


def job_outcome(ray: Any, key: str, reference: Any) -> JobOutcome:
    """Return what a job gave, or what became of it.

    Args:
        ray: the module.
        key: of the job.
        reference: Ray's, of its result.
    """
    try:
        found = ray.get(reference)
    except ray.exceptions.RayError as lost:  # every retry lost its process, or nothing came back
        why = (str(lost).strip() or type(lost).__name__).splitlines()[0]
        return JobOutcome(key, error=f"lost on the cluster: {why}")
    return JobOutcome(key, *found)


@contextlib.contextmanager
def _connected(ray: Any, address: str | None) -> Iterator[None]:
    """Use the cluster that this process is connected to, else connect for the block."""
    if ray.is_initialized():
        yield
        return
    try:
        own = "local"  # None joins whatever cluster was started here last
        ray.init(address=address or own, logging_level=logging.ERROR, log_to_driver=False)
    except (ConnectionError, RuntimeError, ValueError) as error:
        raise StudyError(
            f"execution.address: no Ray cluster at {address!r} ({error}); ray start --head starts "
            "one on this machine, and without address one is started for the command"
        ) from None
    try:
        yield
    finally:
        ray.shutdown()


def _ray() -> Any:
    """Return the package ray.

    Raises:
        StudyError: it is not installed.
    """
    try:
        import ray
    except ImportError:
        raise StudyError(
            "execution.engine: ray is not installed here: pip install 'bo-sysid[ray]', or "
            "execution: {engine: local}"
        ) from None
    return ray
