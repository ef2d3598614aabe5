"""Acquisitions by name: those of this package, and those that a user adds with a decorator."""

from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING

from bo_sysid.acquisition.context import SelectionContext
from bo_sysid.errors import StudyError, nearest

if TYPE_CHECKING:
    from botorch.acquisition import AcquisitionFunction

Factory = Callable[[SelectionContext], "AcquisitionFunction"]

# name -> module; its `build` makes the acquisition. Imported on use: torch takes seconds to load.
_BUILT_IN = {
    "argmin-entropy": "argmin_entropy",
    "entropy-reduction": "entropy_reduction",
    "full-grid": "full_grid",
    "greedy": "greedy",
    "knowledge-gradient": "knowledge_gradient",
    "log-expected-improvement": "log_expected_improvement",
    "max-value-entropy": "max_value_entropy",
    "minimum-mean": "minimum_mean",
    "random": "random_order",
    "sobol": "sobol_order",
    "thompson": "thompson",
}
_ADDED: dict[str, Factory] = {}


def acquisition_names() -> tuple[str, ...]:
    """Return the names of all acquisitions, sorted."""
    return tuple(sorted({*_BUILT_IN, *_ADDED}))


def register_acquisition(name: str) -> Callable[[Factory], Factory]:
    """Return a decorator that makes a factory available under `name`.

    The factory takes a `SelectionContext` and returns a BoTorch `AcquisitionFunction` whose
    `forward` maps `b x 1 x d` rows of B to `b` values; the largest value is evaluated next.

    Raises:
        StudyError: the name is taken.
    """
    if name in acquisition_names():
        raise StudyError(f"acquisition {name!r} exists already; choose another name")

    def add(factory: Factory) -> Factory:
        _ADDED[name] = factory
        return factory

    return add


def acquisition(name: str) -> Factory:
    """Return the factory of the acquisition called `name`.

    Raises:
        StudyError: there is none.
    """
    if name in _ADDED:
        return _ADDED[name]
    if name not in _BUILT_IN:
        hint = nearest(name, acquisition_names())
        raise StudyError(f"search.acquisition: there is no acquisition {name!r}; {hint}")
    factory: Factory = import_module(f"bo_sysid.acquisition.{_BUILT_IN[name]}").build
    return factory


def build_acquisition(name: str, context: SelectionContext) -> "AcquisitionFunction":
    """Return the acquisition called `name` for the state of the search.

    Raises:
        StudyError: there is none.
    """
    return acquisition(name)(context)
