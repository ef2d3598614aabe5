"""The checks of shapes and types that every test runs with."""

from collections.abc import Callable

import jaxtyping
import mujoco
import numpy as np
import pytest
import typechecking

from bo_sysid.mjcf.touching import touching


def law() -> Callable[[float], int]:
    """Return a function that is defined anew, as laws are, and breaks what it promises."""

    @jaxtyping.jaxtyped(typechecker=typechecking.check)
    def made(x: float) -> int:
        return x  # type: ignore[return-value]

    return made


def refused(function: Callable[[float], int]) -> bool:
    try:
        function(0.5)
    except jaxtyping.TypeCheckError:
        return True
    return False


def test_the_package_is_checked() -> None:
    still = mujoco.MjModel.from_xml_string("<mujoco/>")
    assert touching(still, np.zeros((1, 0))) == 0.0
    with pytest.raises(jaxtyping.TypeCheckError, match="poses"):
        touching(still, np.zeros(3))


@pytest.mark.parametrize("again", [False, True])  # the second test begins anew
def test_the_first_calls_and_definitions_are_checked(again: bool) -> None:
    made = [refused(law()) for _ in range(typechecking.DEFINED + 5)]
    assert made == [True] * typechecking.DEFINED + [False] * 5
    typechecking.renew()
    once = law()
    called = [refused(once) for _ in range(typechecking.FIRST + 5)]
    assert called == [True] * typechecking.FIRST + [False] * 5
    typechecking.renew()
    assert refused(once)
