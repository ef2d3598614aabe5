"""The type checker that the tests install in every module: ints are floats, as everywhere else.

What is called once a simulation step took three quarters of the longest tests for being checked.
Each test checks the first calls of every function, and no more of them. A function within another
is one function however often it is defined: laws are defined anew for every simulation, and to
make a checker for each of them took two thirds of what was left.
"""

import sys
from collections import Counter
from collections.abc import Callable
from functools import partial, wraps
from types import CodeType
from typing import Any
from weakref import WeakKeyDictionary, WeakSet

import jaxtyping
from beartype import BeartypeConf, beartype

FIRST = 100  # calls of a function that a test checks
DEFINED = 10  # definitions of a function within another, likewise

_beartype = beartype(conf=BeartypeConf(is_pep484_tower=True))
_jaxtyped = jaxtyping.jaxtyped
_calls: WeakKeyDictionary[Callable[..., object], int] = WeakKeyDictionary()
_defined: Counter[CodeType] = Counter()
_resting: WeakSet[Callable[..., object]] = WeakSet()


def check(signature: Callable[..., object]) -> Callable[..., object]:
    """Return a function that checks arguments, and what is returned, by their annotations.

    jaxtyping calls it beside the function that is checked and makes no use of what it returns.
    """
    checked = None  # most functions of a package are called by few tests

    @wraps(signature)
    def counted(*args: object, **kwargs: object) -> object:
        nonlocal checked
        _calls[counted] = _calls.get(counted, 0) + 1
        if _calls[counted] <= FIRST:
            checked = checked or _beartype(signature)
            return checked(*args, **kwargs)
        _rest()
        return None

    return counted


def jaxtyped(fn: Any = None, *, typechecker: Any) -> Any:
    """Decorate as jaxtyping does, but the first definitions alone of a function within another."""
    if fn is None:
        return partial(jaxtyped, typechecker=typechecker)
    code = getattr(fn, "__code__", None)
    if code is not None and "<locals>" in fn.__qualname__:
        _defined[code] += 1
        if _defined[code] > DEFINED:
            return fn
    return _jaxtyped(fn, typechecker=typechecker)


jaxtyping.jaxtyped = jaxtyped


def renew() -> None:
    """Check the first calls of all functions again."""
    for function in _resting:
        del function.__no_type_check__
    _resting.clear()
    _calls.clear()
    _defined.clear()


def _rest() -> None:
    """Tell jaxtyping to let the function be that it checks now.

    Its wrapper, two calls above the checker, is the only one to know it: a law is defined anew for
    every simulation and has no name by which to find it.
    """
    wrapper = sys._getframe(3)
    for function in (known() for known in wrapper.f_locals["wrapped_fn_holder"]):
        function.__no_type_check__ = True
        _resting.add(function)
