"""Running Python files of a user's."""

import hashlib
import importlib.util
import sys
from pathlib import Path
from types import ModuleType


def run_file(path: Path) -> ModuleType:
    """Run a user's Python file and return it as a module.

    It stays among the modules, where dataclasses look theirs up, under a name of its own.

    Raises:
        ImportError: it is not a Python file, or ends the program.
        BaseException: whatever else the file raises.
    """
    digest = hashlib.sha256(str(path.resolve()).encode()).hexdigest()[:8]
    spec = importlib.util.spec_from_file_location(f"bo_sysid_user_{path.stem}_{digest}", path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{path.name} is not a Python file (.py)")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    try:
        spec.loader.exec_module(module)
    except SystemExit as error:
        del sys.modules[spec.name]
        raise ImportError(f"{path.name} ends the program ({error!r}) while it is read") from None
    except BaseException:
        del sys.modules[spec.name]
        raise
    return module
