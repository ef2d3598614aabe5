"""What every test is kept from: effects that another one registered."""

from collections.abc import Iterator

import pytest

from bo_sysid.effects import registry


@pytest.fixture(autouse=True)
def _own_catalogue() -> Iterator[None]:
    before = dict(registry._EFFECTS)
    yield
    registry._EFFECTS.clear()
    registry._EFFECTS.update(before)
