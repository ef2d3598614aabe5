"""The type checker that the tests install in every module: ints are floats, as everywhere else.

What is called once a simulation step took three quarters of the longest tests for being checked.
Each test checks the first calls of every function, and no more of them.
"""

import sys
from collections.abc import Callable
from functools import wraps
from weakref import WeakKeyDictionary, WeakSet

from beartype import BeartypeConf, beartype

FIRST = 100  # calls of a function that a test checks

_beartype = beartype(conf=BeartypeConf(is_pep484_tower=True))
_calls: WeakKeyDictionary[Callable[..., object], int] = WeakKeyDictionary()
_resting: WeakSet[Callable[..., object]] = WeakSet()


def check(signature: Callable[..., object]) -> Callable[..., object]:
    """Return a function that checks arguments, and what is returned, by their annotations.

    jaxtyping calls it beside the function that is checked and makes no use of what it returns.
    """
    checked = _beartype(signature)

    @wraps(signature)
    def counted(*args: object, **kwargs: object) -> object:
        _calls[counted] = _calls.get(counted, 0) + 1
        if _calls[counted] <= FIRST:
            return checked(*args, **kwargs)
        _rest()
        return None

    return counted


def renew() -> None:
    """Check the first calls of all functions again."""
    for function in _resting:
        del function.__no_type_check__
    _resting.clear()
    _calls.clear()


def _rest() -> None:
    """Tell jaxtyping to let the function be that it checks now.

    Its wrapper, two calls above the checker, is the only one to know it: a law is defined anew for
    every simulation and has no name by which to find it.
    """
    wrapper = sys._getframe(3)
    for function in (known() for known in wrapper.f_locals["wrapped_fn_holder"]):
        function.__no_type_check__ = True
        _resting.add(function)
