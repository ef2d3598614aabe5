"""Find where a MuJoCo simulation and a real machine disagree, and repair the model.

Names are imported when they are first used, so that the command line answers at once.
"""

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

_EXPORTS = {
    "Recording": "bo_sysid.recording",
    "Study": "bo_sysid.study",
    "diagnose": "bo_sysid.diagnosis",
    "identify": "bo_sysid.identify",
    "learn": "bo_sysid.learn.learn",
}

__all__ = ["Recording", "Study", "diagnose", "identify", "learn"]


def __getattr__(name: str) -> Any:
    if name in _EXPORTS:
        value = getattr(import_module(_EXPORTS[name]), name)
        globals()[name] = value  # importing a package of that name has put the package there
        return value
    raise AttributeError(f"module 'bo_sysid' has no attribute {name!r}")
