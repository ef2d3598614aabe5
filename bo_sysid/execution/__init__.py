"""How many threads, which processes or cluster, and how progress is reported."""

from bo_sysid.execution.cluster import RayEngine
from bo_sysid.execution.jobs import JobEngine, JobOutcome
from bo_sysid.execution.local import LocalEngine, map_jobs
from bo_sysid.execution.progress import OnProgress, Progress, silent
from bo_sysid.execution.threads import cores, limit_threads, threads, use_threads
from bo_sysid.execution.where import ENGINES, open_engine

__all__ = [
    "ENGINES",
    "JobEngine",
    "JobOutcome",
    "LocalEngine",
    "OnProgress",
    "Progress",
    "RayEngine",
    "cores",
    "limit_threads",
    "map_jobs",
    "open_engine",
    "silent",
    "threads",
    "use_threads",
]
