"""The versions that made a run: of this package, Python and what results depend on."""

import contextlib
import hashlib
import platform
from functools import cache
from importlib import metadata
from pathlib import Path

from bo_sysid import __version__

PACKAGES = ("botorch", "dm-control", "gpytorch", "mujoco", "numpy", "pandas", "scipy", "torch")
"""Packages whose versions can change a result."""


def versions() -> dict[str, str]:
    """Return the versions of this package, Python and what results depend on.

    That of this package goes by its code: two states of a clone are no more the same than two
    releases.
    """
    found = {"bo-sysid": f"{__version__}+{_source()}", "python": platform.python_version()}
    for package in PACKAGES:
        with contextlib.suppress(metadata.PackageNotFoundError):
            found[package] = metadata.version(package)
    return found


@cache
def _source() -> str:
    """Return the first digits of a hash over the package's Python files."""
    root, found = Path(__file__).parents[1], hashlib.sha256()
    for file in sorted(root.rglob("*.py")):
        found.update(file.relative_to(root).as_posix().encode() + b"\0" + file.read_bytes())
    return found.hexdigest()[:12]
