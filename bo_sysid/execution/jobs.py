"""Jobs: what comes of them, and where they run."""

import traceback
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from bo_sysid.errors import BoSysidError, JobError, UserError, is_input_error
from bo_sysid.execution.threads import use_threads


@dataclass(frozen=True)
class JobOutcome:
    """What came of a job.

    Attributes:
        key: the job.
        result: what the function returned; None where it failed.
        error: why it failed; None where it did not.
        wrong_input: whether it failed because study, model or recordings are wrong.
    """

    key: str
    result: Any = None
    error: str | None = None
    wrong_input: bool = False

    def failure(self, wrong: type[UserError], message: str) -> BoSysidError:
        """Return what a job that failed raises: `wrong` where its input is, else a `JobError`."""
        return (wrong if self.wrong_input else JobError)(message)


@runtime_checkable
class JobEngine(Protocol):
    """Where jobs run: processes of this machine, or a cluster."""

    def run(self, function: Callable[[Any], Any], jobs: Mapping[str, Any]) -> Iterator[JobOutcome]:
        """Yield the outcome of ``function(job)`` for every job, in the order they end."""
        ...


def answer(function: Callable[[Any], Any], job: Any) -> tuple[Any, str | None, bool]:
    """Return the result of a job, or why it failed and whether its input is wrong."""
    try:
        with use_threads(1):
            return function(job), None, False
    except BoSysidError as error:
        return None, str(error), isinstance(error, UserError)
    except Exception as error:  # the job is reported as failed, the others go on
        if isinstance(error, OSError) and is_input_error(error):
            return None, f"{error.filename}: {error.strerror}", True
        return None, traceback.format_exc(), False
