"""What a fit says in numbers, with their 95 % intervals."""

from collections.abc import Callable
from dataclasses import replace
from string import Formatter

import numpy as np
from jaxtyping import Float

from bo_sysid.diagnosis.sets.fit import Fit
from bo_sysid.diagnosis.sets.shapes import ranges
from bo_sysid.diagnosis.windows.candidate import Candidate, slices_of
from bo_sysid.effects import Machine, unit_at
from bo_sysid.intervals import Quantity

_QUANTILE = 1.96
_RELATIVE = 0.005  # model error of magnitudes, beside the statistical one
_RELATIVE_PRESLIDING = (
    0.15  # the same of speed and presliding of friction: a time step changes what they do
)
_TIME = 0.3e-3  # [s] the same for times
_UNMOVED = 1e-6  # of a parameter's range: what its bounds leave beside the model's own value


def quantities(fit: Fit, machine: Machine) -> tuple[Quantity, ...]:
    """Return the value of each member of a fit as it is reported."""
    slices = slices_of(fit.members)
    return tuple(
        _value(c, x, fit.covariance[own, own], machine)
        for c, x, own in zip(fit.members, fit.x, slices, strict=True)
    )


def parameters_of(fit: Fit, machine: Machine) -> tuple[Quantity, ...]:
    """Return what each of the study's parameters in a fit was fitted to.

    A fit knows them as changes of the model's own values.
    """
    h = fit.hypothesis
    said = []
    for c, x, own in zip(h.nuisances, h.nuisance_x, h.slices[len(h.members) :], strict=True):
        model = c.effect.nominal(c.site, machine)
        moved = 0.0 if abs(x[0]) < _UNMOVED * (c.high - c.low)[0] else float(x[0])
        found = _quantity(model + moved, fit.covariance[own, own].item(), c.effect.unit)
        said.append(_within(found, model + float(c.low[0]), model + float(c.high[0])))
    return tuple(said)


def _value(
    c: Candidate, x: np.ndarray, covariance: Float[np.ndarray, "l l"], machine: Machine
) -> Quantity:
    """Return the reported value; its variance to first order, its interval within the bounds."""

    def reported(x: np.ndarray) -> float:
        return float(c.effect.reported(c.full(x), machine, c.site))

    at, gradient = reported(x), _gradient(reported, c, x, 1e-4, 1e-6)
    unit = unit_at(c.effect.unit, c.site, machine)
    found = _quantity(at, float(gradient @ covariance @ gradient), unit)
    if c.size > 1:
        return found
    low, high = sorted((reported(c.low), reported(c.high)))
    return _within(found, low, high)


def _within(quantity: Quantity, low: float, high: float) -> Quantity:
    """Return a quantity whose interval ends where the magnitude was not searched for.

    It holds the value all the same: finer shapes are tried on both sides of the last of a grid.
    """
    low, high = min(low, quantity.value), max(high, quantity.value)
    first, last = quantity.interval
    return replace(quantity, interval=(max(low, first), min(high, last)))


def _quantity(value: float, variance: float, unit: str, relative: float = _RELATIVE) -> Quantity:
    floor = _TIME if unit == "s" else 0.0
    half = _QUANTILE * float(np.sqrt(max(variance, 0.0) + (relative * value) ** 2 + floor**2))
    return Quantity(float(value), unit, (float(value) - half, float(value) + half))


def details_of(
    c: Candidate,
    x: np.ndarray,
    covariance: Float[np.ndarray, "l l"],
    spread: Float[np.ndarray, " s"],
    machine: Machine,
) -> dict[str, Quantity]:
    """Return further components of an effect by name, and what follows from its magnitudes.

    Those that its sentence asks for are among them in any case.

    Args:
        c: what was found.
        x: its magnitudes.
        covariance: of these.
        spread: standard deviations of its shapes.
        machine: with the model that it is added to.
    """
    out: dict[str, Quantity] = {}
    full, variances = c.full(x), np.concatenate([np.diag(covariance), spread**2])
    low, high = _searched(c, machine)
    asked = {name for _, name, *_ in Formatter().parse(c.effect.sentence)}
    for i, component in enumerate(c.effect.components):
        if i == 0 and c.effect.vector == 1 and component.name not in asked:
            continue  # it is the value
        if c.effect.discrete:
            continue  # there or not
        fitted, last = i < c.size, i == len(full) - 1
        optional = not fitted and ((c.may_preslide and last) or not c.extent.grid)
        if optional and full[i] == c.extent.probe[i] and component.name not in asked:
            continue  # as it usually is
        unit = unit_at(component.unit, c.site, machine)
        relative = _RELATIVE_PRESLIDING if c.may_preslide and not fitted else _RELATIVE
        found = _quantity(float(full[i]), float(variances[i]), unit, relative)
        out[component.name] = _within(found, low[i], high[i])
    if c.effect.details is not None:
        derived = c.effect.details(full, machine, c.site)
        for name, (value, unit) in derived.items():
            variance = _propagated(c, x, covariance, machine, name)
            relative = 0.0 if c.effect.discrete else _RELATIVE
            out[name] = _quantity(value, variance, unit, relative)
    return out


def _searched(
    c: Candidate, machine: Machine
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Return where magnitudes and shapes were searched for: shapes also beyond their grid."""
    low, high = np.array(c.extent.low, float), np.array(c.extent.high, float)
    for i, (least, most) in ranges(c, machine).items():
        low[c.size + i] = min(low[c.size + i], least)
        high[c.size + i] = max(high[c.size + i], most)
    return low, high


def _propagated(
    c: Candidate, x: np.ndarray, covariance: np.ndarray, machine: Machine, name: str
) -> float:
    """Return the variance of a derived quantity, to first order."""
    assert c.effect.details is not None  # noqa: S101
    details = c.effect.details
    at = details(c.full(x), machine, c.site)[name]

    def derived(x: np.ndarray) -> float:  # one that is no longer said does not change
        return details(c.full(x), machine, c.site).get(name, at)[0]

    gradient = _gradient(derived, c, x, 1e-3, 1e-3)
    return float(gradient @ covariance @ gradient)


def _gradient(
    of: Callable[[np.ndarray], float], c: Candidate, x: np.ndarray, relative: float, least: float
) -> Float[np.ndarray, " l"]:
    """Return the slope by each magnitude, from steps of a share of it, or of its probe if more."""
    at, gradient = of(x), np.zeros(c.size)
    for i in range(c.size):
        h = max(relative * abs(x[i]), least * abs(c.probe[i]))
        moved = x.copy()
        moved[i] += h
        gradient[i] = (of(moved) - at) / h
    return gradient
