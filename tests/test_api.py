"""Names at the top of the package."""

import importlib

import pytest

import bo_sysid


@pytest.mark.parametrize("name", ["identify", "learn"])
def test_a_command_can_be_called_after_its_package_was_imported(name: str) -> None:
    package = importlib.import_module(f"bo_sysid.{name}")
    for command in (package, getattr(bo_sysid, name)):
        with pytest.raises(TypeError, match=r"required .*'study'"):
            command()
