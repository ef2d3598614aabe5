"""Where jobs run, by the names that studies give."""

from bo_sysid.errors import StudyError, nearest
from bo_sysid.execution.cluster import RayEngine
from bo_sysid.execution.jobs import JobEngine
from bo_sysid.execution.local import LocalEngine
from bo_sysid.execution.threads import threads

ENGINES = ("local", "ray")


def open_engine(name: str = "local", address: str | None = None) -> JobEngine:
    """Return the engine called `name`.

    Args:
        name: "local", a process of this machine for every thread, or "ray".
        address: of the Ray cluster; "auto" finds a running one, None starts one here.

    Raises:
        StudyError: there is no such engine, or Ray is not installed.
    """
    if name == "local":
        return LocalEngine(threads())
    if name == "ray":
        return RayEngine(address)
    raise StudyError(f"execution.engine: unknown engine {name!r}; {nearest(name, ENGINES)}")
