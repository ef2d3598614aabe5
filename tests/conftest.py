"""What every test begins with: the catalogue as it is, and types that are checked."""

import os
from collections.abc import Iterator

os.environ.setdefault(
    "MUJOCO_GL", "disable"
)  # before MuJoCo is imported: it would ask for a display

import pytest
import typechecking

from bo_sysid.effects import registry


@pytest.fixture(autouse=True)
def _own_catalogue() -> Iterator[None]:
    before = dict(registry._EFFECTS)
    yield
    registry._EFFECTS.clear()
    registry._EFFECTS.update(before)


@pytest.fixture(autouse=True)
def _types_checked() -> None:
    typechecking.renew()
