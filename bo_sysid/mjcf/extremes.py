"""Models at the ends of what is not known of their actuators."""

import itertools
from collections.abc import Iterator, Sequence

import mujoco

from bo_sysid.mjcf.address import resolve
from bo_sysid.mjcf.edits import ParameterLike, parameter_edits
from bo_sysid.mjcf.model import Model


def actuator_extremes(
    model: Model, parameters: Sequence[ParameterLike]
) -> tuple[mujoco.MjModel, ...]:
    """Return models among which each actuator has its largest force per command and its least.

    Gear times gain is linear in each of the parameters that it follows from, so that its ends are
    at corners of their box: all of them are taken for each actuator. What is not of an actuator
    stays as the model has it; where all is known of the actuators, that is the only model.

    Args:
        model: the nominal model.
        parameters: what is not known.

    Raises:
        ModelError: an address matches nothing, or two parameters share one.
    """
    touched = [_actuators(model, p) for p in parameters]
    own = [p for p, names in zip(parameters, touched, strict=True) if names]
    of = [names for names in touched if names]
    points = {
        point for name in set().union(*of) for point in _corners(own, [name in n for n in of])
    }
    edits = [parameter_edits(model, own, point) for point in sorted(points) or [()]]
    return tuple(model.compile(e) for e in edits)


def _actuators(model: Model, parameter: ParameterLike) -> set[str]:
    """Return the names of the actuators that have numbers of a parameter."""
    targets = (t for address in parameter.addresses for t in resolve(model, address))
    return {t.element for t in targets if t.kind == "actuator"}


def _corners(
    parameters: Sequence[ParameterLike], free: Sequence[bool]
) -> Iterator[tuple[float, ...]]:
    """Yield the corners of the box of the parameters that are free, the others at their least."""
    ends = [(p.low, p.high) if f else (p.low,) for p, f in zip(parameters, free, strict=True)]
    return itertools.product(*ends)
