"""How a column is to be read: its unit, as its name or its reach says, and its clock."""

from collections.abc import Sequence
from dataclasses import replace
from math import log, pi
from typing import Literal

import mujoco
import numpy as np

from bo_sysid.checks.proposal import Rule
from bo_sysid.mjcf.commands import driven_joint, is_position_servo
from bo_sysid.mjcf.joints import HINGE
from bo_sysid.recording import RawTable
from bo_sysid.recording.units import Unit, is_unit, unit
from bo_sysid.starter.columns import BY_STEPS
from bo_sysid.starter.matching import Guess
from bo_sysid.starter.naming import Column

ControlKind = Literal["position", "velocity", "force"]
"""What a control sets: where to go, how fast, or what to exert."""
_TURNS = 4 * pi  # a hinge that seems to move by more is not in radians
_TICK_RULE: Rule = {"unit": "ticks", "scale": round(2 * pi / 4096, 8)}
_TICK_GUESS = "its scale is a guess, 4096 ticks a turn"
_FITS = {
    "qpos": ("angle", "length"),
    "qvel": ("angular velocity", "velocity"),
    "ctrl": (
        "current", "voltage", "torque", "force", "ratio", "angle", "length", "angular velocity",
        "velocity", "pressure",
    ),
}  # fmt: skip
_ELECTRIC = ("current", "voltage")  # no torque, which is worth saying of an A, too
_UNTOLD = 0.5  # the most that a unit which only the reach speaks for can be sure
_CLOCKS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_USUAL = 5e-3  # [s] between samples: of units, that in which a step comes nearest
_SHORTEST, _LONGEST = 8e-5, 0.4  # [s] between samples, of fast and slow logs
_ROUNDED = 1.0  # by which a percentage may pass the largest
_STEPPED = 0.7  # how sure a unit is for which the steps of a clock speak


def stated_unit(name: str, where: str) -> Unit:
    """Return a unit that a name may carry; one of no quantity where it is none."""
    return unit(name, where) if is_unit(name) else Unit("", "", 1.0)


def fits_joint(compiled: mujoco.MjModel, joint: str, column: Column) -> bool:
    """Whether a column's unit lets it be a joint's position: no length is that of a hinge."""
    hinge = int(compiled.joint(joint).type[0]) == HINGE
    return stated_unit(column.unit, column.name).quantity != ("length" if hinge else "angle")


def driven(compiled: mujoco.MjModel, channel: str) -> str:
    """Return the joint that a position, a speed or a control is about; empty where none."""
    kind, _, element = channel.partition(".")
    if kind in ("qpos", "qvel"):
        return element
    if kind != "ctrl":
        return ""
    return driven_joint(compiled, compiled.actuator(element).id) or ""


def control_kind(compiled: mujoco.MjModel, actuator: str) -> ControlKind:
    """Return what an actuator takes; a servo of speed brakes as much as its gain drives."""
    found = compiled.actuator(actuator)
    if is_position_servo(compiled, found.id):
        integrates = int(found.dyntype[0]) == int(mujoco.mjtDyn.mjDYN_INTEGRATOR)
        return "velocity" if integrates else "position"
    return "velocity" if 0 != found.gainprm[0] == -found.biasprm[2] else "force"


def constant_hint(compiled: mujoco.MjModel, actuator: str, stated: str) -> str:
    """Return what makes a force of a motor's current, where its control is one; else nothing."""
    found = compiled.actuator(actuator)
    plain = int(found.gaintype[0]) == int(mujoco.mjtGain.mjGAIN_FIXED)
    plain &= int(found.biastype[0]) == int(mujoco.mjtBias.mjBIAS_NONE)
    if not plain or stated_unit(stated, actuator).quantity != "current":
        return ""
    gear, joint = float(found.gear[0]), driven(compiled, f"ctrl.{actuator}")
    slides = bool(joint) and int(compiled.joint(joint).type[0]) != HINGE
    force = "N" if slides and gear == 1 else "N m"
    before = "" if gear == 1 else f" before the gear; the model multiplies by its gear of {gear:g}"
    return f"{actuator} is told in A: scale is the motor's constant in {force}/A{before}"


def without_constant(guess: Guess) -> Guess:
    """Return the guess of a current of which nothing says what force it gives."""
    reason = f"{guess.reason}; its scale is missing, 1 A counts as 1 N m (N)"
    return replace(guess, reason=reason, confidence=min(guess.confidence, _UNTOLD))


def column_rule(table: RawTable, compiled: mujoco.MjModel, guess: Guess) -> tuple[Rule, Guess]:
    """Return the rule of a guess, and the guess, less sure where a unit was guessed as well."""
    rule: Rule = {"from": guess.column}
    if guess.column == guess.channel:  # it ends as the element is called
        rule, guess = {}, replace(guess, unit=table.units.get(guess.column, ""))
    kind, element = guess.channel.split(".", 1)
    unit = stated_unit(guess.unit, guess.column)
    fits = unit.quantity in _FITS.get(kind, ()) and table.units.get(guess.column) is None
    if kind == "qpos" and unit.quantity == "count":
        reason = f"{guess.reason}; {_TICK_GUESS}"
        guess = replace(guess, reason=reason, confidence=min(guess.confidence, _UNTOLD))
        rule |= _TICK_RULE
    elif fits and (unit.factor != 1 or unit.quantity in _ELECTRIC):
        ratio = unit.quantity == "ratio"
        if not (ratio and _takes_percent(compiled, element, table.column(guess.column))):
            rule["unit"] = guess.unit
    elif unit.quantity != "angle" and (joint := _placed(compiled, kind, element)):
        made, reach = _by_reach(table, compiled, joint, guess.column)
        if made:
            reason = f"{guess.reason}; {made['unit']}, since it reaches {reach:.4g}"
            reason += f"; {_TICK_GUESS}" if made is _TICK_RULE else ""
            guess = replace(guess, reason=reason, confidence=min(guess.confidence, _UNTOLD))
        rule |= made
    return rule, guess


def _takes_percent(compiled: mujoco.MjModel, actuator: str, column: np.ndarray) -> bool:
    """Whether a control is bounded by more than 1, and by no less than its column has."""
    found = compiled.actuator(actuator)
    most = float(np.abs(found.ctrlrange).max()) if found.ctrllimited[0] else 0.0
    return most > max(1.0, float(np.nanmax(np.abs(column))) - _ROUNDED)


def _placed(compiled: mujoco.MjModel, kind: str, element: str) -> str:
    """Return the joint of which a channel is a place: its own, or a servo's goal; else empty."""
    if kind == "qpos":
        return element
    if kind != "ctrl":
        return ""
    goal = control_kind(compiled, element) == "position"
    return driven(compiled, f"ctrl.{element}") if goal else ""


def _by_reach(
    table: RawTable, compiled: mujoco.MjModel, joint: str, column: str
) -> tuple[Rule, float]:
    """Return the unit of a hinge by how far it seems to move; none where it may be rad.

    A hinge without limits may turn as often as it likes: what the motion says decides.
    """
    values = table.column(column)
    values = values[np.isfinite(values)]
    whole = bool((values == np.rint(values)).all())
    reach = float(np.abs(values).max())
    place = compiled.joint(joint).id
    if int(compiled.jnt_type[place]) != HINGE:
        return {}, reach
    if whole and reach > 500:
        return _TICK_RULE, reach
    return {"unit": "deg"} if reach > _TURNS and compiled.jnt_limited[place] else {}, reach


def _rises(table: RawTable, column: Column) -> bool:
    """Whether a column never falls, as a clock's."""
    values = table.column(column.name)
    return bool((np.diff(values[np.isfinite(values)]) >= 0).all())


def clock_rule(table: RawTable, columns: Sequence[Column]) -> tuple[Rule, Guess | None]:
    """Return the rule of the clock where it has another name or unit; empty where it is told.

    Beside it stands the guess where the steps of the clock alone speak for its unit.
    """
    clocks = [c for c in columns if c.kind == "time"]
    if table.rate:
        return {"rate": table.rate}, None
    if table.clocks or not clocks:
        return {}, None
    clock = max(clocks, key=lambda c: (c.name.lower() == "time", _rises(table, c)))
    rule: Rule = {} if clock.name == "time" else {"from": clock.name}
    if table.columns[clock.name].dtype.kind in "mM":  # read in seconds, however it is called
        return rule, None
    if stated_unit(clock.unit, clock.name).quantity == "time":
        return rule | {"unit": clock.unit}, None
    values = table.column(clock.name)
    steps = np.diff(values[np.isfinite(values)])
    guess = _by_steps(float(np.median(steps)), clock.name) if steps.size else None
    if clock.reason == BY_STEPS:
        guess = guess or Guess("time", clock.name, "s", BY_STEPS, _STEPPED)
        if (steps == 1).all():
            reason = f"{guess.reason}; it counts the rows, and may be no clock"
            guess = replace(guess, reason=reason, confidence=_UNTOLD)
    return (rule if guess is None else rule | {"unit": guess.unit}), guess


def _by_steps(step: float, column: str) -> Guess | None:
    """Return the unit of a clock by its median step; None where these are seconds, and no other.

    One step may be that of a slow log in one unit and of a fast log in the next.
    """
    if not step > 0:
        return None
    lasts = {u: step * seconds for u, seconds in _CLOCKS.items()}
    named = min(lasts, key=lambda u: abs(log(lasts[u] / _USUAL)))
    others = [u for u, t in lasts.items() if u != named and _SHORTEST < t < _LONGEST]
    if named == "s" and not others:
        return None
    durations = [f"{1e3 * lasts[u]:.4g} ms in {u}" for u in (named, *others)]
    reason = f"its steps, of {', but '.join(durations)}"
    return Guess("time", column, named, reason, _UNTOLD if others else _STEPPED)
