"""Names at the top of the package."""

import importlib
import os
import subprocess
import sys

import pytest

import bo_sysid


@pytest.mark.parametrize("name", ["identify", "learn"])
def test_a_command_can_be_called_after_its_package_was_imported(name: str) -> None:
    package = importlib.import_module(f"bo_sysid.{name}")
    for command in (package, getattr(bo_sysid, name)):
        with pytest.raises(TypeError, match=r"required .*'study'"):
            command()


def test_importing_the_package_leaves_rendering_as_it_is() -> None:
    code = "import os, bo_sysid; from bo_sysid import Study; print(os.environ.get('MUJOCO_GL'))"
    environment = {k: v for k, v in os.environ.items() if k != "MUJOCO_GL"}
    done = subprocess.run(  # noqa: S603
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment
    )
    assert done.stdout.strip() == "None"
