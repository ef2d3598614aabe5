"""The rules of a log corrected by what its motion says."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import mujoco
import pandas as pd

from bo_sysid.checks.hypothesis import FREE
from bo_sysid.checks.proposal import proposed_clocks, proposed_columns
from bo_sysid.checks.wiring import Wiring, find_wiring
from bo_sysid.checks.wiring_text import LOADED
from bo_sysid.checks.wraps import find_wraps, unwrapped
from bo_sysid.mjcf import Model
from bo_sysid.recording import RawTable
from bo_sysid.starter.guess import Rules, read
from bo_sysid.starter.matching import Guess
from bo_sysid.starter.movers import with_movers
from bo_sysid.starter.reading import driven
from bo_sysid.starter.signs import Tested, tested_signs, turned_by_range

_LOOKED_AT = 4  # logs whose motion is looked at
_AGREES = 0.15  # share of the forces that may stay unexplained where the motion agrees
_LIKELY, _OPEN = 0.7, 0.5
_AGREED = "the motion agrees"
_MOTOR = "the motor's constant as the model's masses have it"
_FROM_ONE_END = "counted from one end, with zero in the middle"
_MOVED = ("the motion", "its jumps", _MOTOR, _FROM_ONE_END)


def by_behaviour(model: Model, tables: Sequence[RawTable], rules: Rules) -> Rules:
    """Return the rules corrected by what the recordings support, and how far their signs are told.

    A sign that the model's range asks for stands, unless the motion asks for another one there.
    """
    compiled, moved = model.compile(), tables[:_LOOKED_AT]
    turned = turned_by_range(compiled, [read(t, rules) for t in moved], rules)
    found, wiring = _wired(model, tables, turned)
    for channel, rule in turned.columns.items():
        if rule != rules.columns[channel] and _turns(compiled, wiring, channel):
            found, wiring = _wired(model, tables, rules)
            break
    tested = tested_signs(compiled, [read(t, found) for t in moved])
    return replace(found, guesses=_judged(compiled, found.guesses, tested))


def _turns(model: mujoco.MjModel, wiring: Wiring, position: str) -> bool:
    """Whether a wiring turns a position or a control of its joint."""
    joint = driven(model, position)
    return any(w.sign < 0 and driven(model, n) == joint for n, w in wiring.wires.items())


def _wired(model: Model, tables: Sequence[RawTable], rules: Rules) -> tuple[Rules, Wiring]:
    """Return the rules corrected by the motion, and what was found (`checks.wiring`).

    Jumps are looked for in all logs, motion in the first ones.
    """
    rules = with_movers(model, tables[:_LOOKED_AT], rules)
    wraps = find_wraps([read(t, rules) for t in tables])
    recordings = [read(t, rules) for t in tables[:_LOOKED_AT]]
    compiled = model.compile()
    wiring = find_wiring(compiled, unwrapped(recordings, wraps))
    changed = proposed_columns(rules.columns, wiring.wires, wraps)
    guesses = dict(rules.guesses)
    for channel, rule in changed.items():
        wire = wiring.wires.get(channel)
        reason = "the motion" if wire else "its jumps"
        if wire and wire.centred:
            reason = f"{_FROM_ONE_END}; the motion"
        if wire and wire.unit == FREE:
            reason = f"{_MOTOR}; the motion"
        share = _explained(wiring.balance, driven(compiled, channel))
        column, reason = str(rule.get("from", channel)), f"{reason}: {share}"
        moved = wire is not None and bool(wire.offset)
        reason += f"; {LOADED}" if moved and wire and not wire.centred else ""
        guesses[channel] = Guess(channel, column, "", reason, _OPEN if moved else 0.8)
    clocks = proposed_clocks({}, "ctrl", wiring.delay, linear=wiring.half_early)
    if clocks:
        guesses["clocks.ctrl"] = Guess("clocks.ctrl", "", "", _late(wiring), _LIKELY)
    columns = {**rules.columns, **changed}
    return replace(rules, columns=columns, clocks=clocks, guesses=guesses), wiring


def _late(wiring: Wiring) -> str:
    """Return when the controls act, in words."""
    delay = f"{1e3 * abs(wiring.delay):.1f} ms (± {1.96e3 * wiring.sigma:.1f})"
    if wiring.half_early:
        return (
            f"{delay} earlier than stamped, about half an interval: what is measured and changes "
            "between samples looks so. Of commands that are held, remove this"
        )
    if wiring.delay > 0:
        return (
            f"{delay} later than stamped. Where the machine is late and not the clock of the log, "
            "remove this: `diagnose` then finds its delay, and writes it into the model"
        )
    return (
        f"{delay} earlier than stamped; what is measured and changes between samples looks so, for "
        "that {hold: linear} in its place"
    )


def _judged(
    model: mujoco.MjModel, guesses: Mapping[str, Guess], tested: Tested
) -> dict[str, Guess]:
    """Return the guesses, surer where the motion is balanced, less sure where no sign is told."""
    out, joints = {}, {model.joint(j).name for j in range(model.njnt)}
    for n, g in guesses.items():
        share = tested.left.get(driven(model, n), 1.0)
        if n in tested.undetermined:
            reason = f"its sign is not told: {tested.undetermined[n]}"
            if n.startswith("qpos.") and share <= _AGREES:  # a mirror image of itself
                reason = f"{_AGREED} (unexplained forces {share:.2g}), with either sign"
            g = replace(g, reason=f"{g.reason}; {reason}", confidence=min(g.confidence, _LIKELY))
        elif share <= _AGREES and not g.reason.startswith(_MOVED):
            reason = f"{_AGREED} (unexplained forces {share:.2g})"
            if n in tested.mirrored:
                reason += f", as well with {tested.mirrored[n]} and this both turned"
            g = replace(g, reason=f"{g.reason}; {reason}", confidence=max(g.confidence, _LIKELY))
        elif n.startswith("qpos.") and driven(model, n) in joints and share > _AGREES:
            reason = "the motion of others tells its sign"
            if driven(model, n) in tested.left:
                reason = (
                    f"the motion tells its sign; {100 * share:.0f} % of the forces there stay "
                    "unexplained"
                )
            g = replace(g, reason=f"{g.reason}; {reason}")
        out[n] = g
    return out


def agrees(guess: Guess) -> bool:
    """Whether the motion agrees with a guess."""
    return _AGREED in guess.reason


def _explained(balance: pd.DataFrame, joint: str) -> str:
    """Return what stays unexplained at a joint, and where that is not known, at the worst."""
    used = balance[balance["used"].astype(bool)]
    own = used[used["joint"] == joint]
    used = used if own.empty else own
    if used.empty:
        return "tested"
    return f"unexplained forces {used['before'].max():.2g} → {used['after'].max():.2g}"
