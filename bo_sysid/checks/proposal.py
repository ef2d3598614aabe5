"""The `columns:` and `clocks:` that a log should be read with, from what was found in it."""

from collections.abc import Mapping
from dataclasses import fields
from math import isclose, pi
from typing import Any

from bo_sysid.checks.hypothesis import Wire
from bo_sysid.checks.wraps import Wrap
from bo_sysid.recording.columns import ClockRule, ColumnRule
from bo_sysid.recording.units import is_unit, unit
from bo_sysid.yaml_text import dumped

Rule = dict[str, Any]
_KEPT = ("unit", "signed", "hold", "clock", "missing")
_NO_SHIFT = 5e-4  # [s] that is within what a delay is known to
_DIGITS = 14  # of a sum, beyond which it is rounding
_DEFAULTS = {f.name: f.default for f in (*fields(ColumnRule), *fields(ClockRule))}


def proposed_columns(
    written: Mapping[str, Mapping[str, Any]],
    wires: Mapping[str, Wire],
    wraps: Mapping[str, Wrap],
) -> dict[str, Rule]:
    """Return the rules that should replace those of a study.

    Args:
        written: the study's ``columns:``, as a mapping with ``from``.
        wires: what the channels really are, of what these rules read.
        wraps: channels that jump.

    Returns:
        Rules of the channels that change, as they stand in a study.
    """
    out = {}
    for name in dict.fromkeys([*wires, *wraps]):
        wire = wires.get(name, Wire(name))
        rule = dict(written.get(wire.source, {}))
        column = rule.pop("from", None) or wire.source
        sign, scale, offset = (
            rule.pop(k, d) for k, d in (("sign", 1), ("scale", 1), ("offset", 0))
        )
        whole = scale * wire.scale * (_factor(rule.get("unit")) or 1.0)
        if isclose(whole, _factor(wire.unit) or 0.0, rel_tol=1e-9):
            rule["unit"], scale = wire.unit, 1
        elif wire.unit == "ticks":
            rule["unit"], scale = "ticks", whole
        else:
            scale *= wire.scale
        made: Rule = {} if column == name else {"from": column}
        made |= {k: v for k, v in rule.items() if k in _KEPT and v != _DEFAULTS[k]}
        if sign * wire.sign < 0:
            made["sign"] = -1
        if scale != 1:
            made["scale"] = _rounded(scale)
        if less := wire.less or rule.get("less"):
            made["less"] = less
        theirs = wire.sign * wire.scale * offset
        if shift := _sum(theirs, wire.offset, 4):
            made["offset"] = shift
        wrap, own = wraps.get(wire.source), rule.get("unwrap")
        if wrap is not None and wrap.signed:
            made["signed"] = wrap.signed
        elif wrap is not None:
            made["unwrap"] = _unwrap(wrap.period * wire.scale)
        elif own:
            made["unwrap"] = True if own is True else _unwrap(own * wire.scale)
        out[name] = made
    return out


def _factor(name: str | None) -> float | None:
    """Return the SI value of one unit; None where it has none, or there is no such unit."""
    return unit(name, "columns").factor if name and is_unit(name) else None


def _unwrap(period: float) -> bool | float:
    """Return the size of a jump as it stands in a rule: true where it is a turn."""
    return True if isclose(period, 2 * pi, rel_tol=1e-3) else _rounded(period)


def proposed_clocks(
    written: Mapping[str, Mapping[str, Any]], kind: str, delay: float, *, linear: bool = False
) -> dict[str, Rule]:
    """Return the clocks of the controls with `delay` [s] more in their shifts, which may end.

    A control with a rule of its own does not follow that of its kind. With `linear` they change
    between samples instead, where the study says nothing of them.
    """
    if not delay:
        return {}
    if linear and not any(name.split(".")[0] == kind for name in written):
        return {kind: {"hold": "linear"}}
    own = [name for name in written if name.startswith(f"{kind}.")]
    return {name: _later(written.get(name, {}), delay) for name in (kind, *own)}


def _later(written: Mapping[str, Any], delay: float) -> Rule:
    rule = {k: v for k, v in written.items() if v != _DEFAULTS.get(k)}
    shift = _sum(rule.get("shift", 0.0), delay, 3)
    rule["shift"] = shift if abs(shift) > _NO_SHIFT else 0.0
    return rule


def as_yaml(columns: Mapping[str, Rule], clocks: Mapping[str, Rule]) -> str:
    """Return the two blocks as they stand under ``recordings:`` of a study."""
    lines = []
    for title, block in (("columns", columns), ("clocks", clocks)):
        if block:
            lines.append(f"{title}:")
            lines += [f"  {name}: {flow(rule)}" for name, rule in block.items()]
    return "\n".join(lines)


def flow(rule: Mapping[str, Any]) -> str:
    """Return a rule on one line of YAML."""
    return dumped(rule, flow=True).strip()


def _sum(theirs: float, found: float, digits: int) -> float:
    """Return what is written and what was found, of which so many digits are known.

    However large theirs is, it keeps all of its own.
    """
    return _rounded(theirs + _rounded(found, digits), _DIGITS) if found else theirs


def _rounded(value: float, digits: int = 6) -> float:
    return float(f"{value:.{digits}g}")
