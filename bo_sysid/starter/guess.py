"""From a model and a log to the rules that read it, each with a reason and a confidence."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import pi

import mujoco
import numpy as np
import pandas as pd

from bo_sysid.checks.hypothesis import FREE
from bo_sysid.checks.proposal import Rule, proposed_clocks, proposed_columns
from bo_sysid.checks.wiring import Wiring, find_wiring
from bo_sysid.checks.wraps import find_wraps, unwrapped
from bo_sysid.errors import RecordingError, nearest
from bo_sysid.mjcf import Model
from bo_sysid.recording import RawTable, Recording
from bo_sysid.recording.mapping import to_recording
from bo_sysid.recording.units import Unit, is_unit, unit
from bo_sysid.starter.columns import WORDS, Column, describe, spoilt
from bo_sysid.starter.matching import Guess, match, named_after, rates_of

_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
_TURNS = 4 * pi  # a hinge that seems to move by more is not in radians
_TICK_RULE: Rule = {"unit": "ticks", "scale": round(2 * pi / 4096, 8)}
_AGREES = 0.15  # share of the forces that may stay unexplained where the motion agrees
_LIKELY = 0.7
_MOTOR = "the motor's constant as the model's masses have it"
_FITS = {
    "qpos": ("angle", "length"),
    "qvel": ("angular velocity", "velocity"),
    "ctrl": ("current", "voltage", "torque", "force", "ratio", "angle", "length"),
}
_ELECTRIC = ("current", "voltage")  # no torque, which is worth saying of an A, too
_UNTOLD = 0.5  # the most that a unit which only the reach speaks for can be sure


@dataclass(frozen=True)
class Rules:
    """How a log is to be read.

    Attributes:
        columns: by channel, the rule as it stands in a study.
        clocks: by kind, the clock as it stands in a study.
        guesses: by channel (or ``time``), the reason and the confidence of its rule.
        held: joints that were not recorded.
        unmatched: actuators without a column.
        unused: columns that nothing was matched with.
    """

    columns: Mapping[str, Rule]
    clocks: Mapping[str, Rule]
    guesses: Mapping[str, Guess]
    held: tuple[str, ...]
    unmatched: tuple[str, ...]
    unused: tuple[str, ...]


def guess_rules(model: Model, table: RawTable) -> Rules:
    """Guess which column is what, by names and by behaviour.

    Args:
        model: the nominal model.
        table: the first log, as a reader returned it.

    Raises:
        RecordingError: no column fits a joint.
    """
    columns = describe(table)
    compiled = model.compile()
    joints = [n for n in model.joints if int(compiled.joint(n).type[0]) >= 2]
    if not joints:
        raise RecordingError(
            f"{table.source}: init matches columns with hinges and slides, and {model.source} has "
            "none; write the study by hand, with columns like "
            + ", ".join(repr(n) for n in model.qpos_channels[:4])
        )
    positions = match(
        "qpos", joints, [c for c in columns if c.kind == "position" or named_after(joints, c)]
    )
    if not positions:
        names = [c.name for c in columns]
        raise RecordingError(
            f"{table.source}: no column looks like the position of a joint of {model.source} "
            f"({', '.join(joints)}); it has {', '.join(map(repr, names))}; for {joints[0]!r}: "
            f"{nearest(joints[0], names)}" + "".join(f"; {s}" for s in spoilt(table))
        )
    velocities = rates_of(table, positions, columns) or match(
        "qvel", [g.channel[5:] for g in positions], [c for c in columns if c.kind == "velocity"]
    )
    commands = _commands(model, compiled, columns)
    commands += _last_one(model, table, columns, (*positions, *velocities, *commands))
    guesses = {g.channel: g for g in (*positions, *velocities, *commands)}
    time = _time(table, columns)
    ruled = {n: _rule(table, compiled, g) for n, g in guesses.items()}
    rules = {n: rule for n, (rule, _) in ruled.items()}
    guesses = {n: guess for n, (_, guess) in ruled.items()}
    if time:
        rules = {"time": time, **rules}
    found = Rules(
        rules,
        {},
        guesses,
        tuple(j for j in joints if f"qpos.{j}" not in guesses),
        tuple(a for a in model.controlled if f"ctrl.{a}" not in guesses),
        tuple(c.name for c in columns if c.kind != "time"
              and c.name not in {g.column for g in guesses.values()}
              and c.name not in (*model.qpos_channels, *model.qvel_channels)),
    )  # fmt: skip
    return found


def by_behaviour(model: Model, tables: Sequence[RawTable], rules: Rules) -> Rules:
    """Return the rules corrected by what the recordings support (`checks.wiring`)."""
    recordings = [read(t, rules) for t in tables]
    wraps = find_wraps(recordings)
    wiring = find_wiring(model.compile(), unwrapped(recordings, wraps))
    changed = proposed_columns(rules.columns, wiring.wires, wraps)
    guesses = _agreed(rules.guesses, wiring.balance, changed)
    for channel, rule in changed.items():
        wire = wiring.wires.get(channel)
        reason = "the motion" if wire else "its jumps"
        if wire and wire.unit == FREE:
            reason = f"{_MOTOR}; the motion"
        share = _explained(wiring.balance)
        column = str(rule.get("from", channel))
        guesses[channel] = Guess(channel, column, "", f"{reason}: {share}", 0.8)
    clocks = proposed_clocks({}, "ctrl", wiring.delay)
    if clocks:
        guesses["clocks.ctrl"] = Guess("clocks.ctrl", "", "", _late(wiring), 0.7)
    return replace(rules, columns={**rules.columns, **changed}, clocks=clocks, guesses=guesses)


def _late(wiring: Wiring) -> str:
    """Return when the controls act, in words."""
    told = f"{1e3 * abs(wiring.delay):.1f} ms (± {wiring.delays['sigma'].iloc[0]:.1f})"
    if wiring.delay > 0:
        return f"{told} later than stamped"
    return f"{told} earlier than stamped; a command that changes between samples looks so"


def _agreed(
    guesses: Mapping[str, Guess], balance: pd.DataFrame, changed: Mapping[str, Rule]
) -> dict[str, Guess]:
    """Return the guesses, surer where the motion is balanced as they say."""
    used = balance[balance["used"]]
    if used.empty or float(used["after"].max()) > _AGREES:
        return dict(guesses)
    told = f"the motion agrees (unexplained forces {float(used['after'].max()):.2g})"
    return {
        n: g
        if n in changed or g.confidence > _LIKELY
        else replace(g, reason=f"{g.reason}; {told}", confidence=_LIKELY)
        for n, g in guesses.items()
    }


def read(table: RawTable, rules: Rules) -> Recording:
    """Return the table as the rules read it."""
    return to_recording(table, rules.columns, rules.clocks, name=table.name or "log")


def _explained(balance: pd.DataFrame) -> str:
    used = balance[balance["used"]]
    if used.empty:
        return "tested"
    before, after = float(used["before"].max()), float(used["after"].max())
    return f"unexplained forces {before:.2g} → {after:.2g}"


def _commands(model: Model, compiled: mujoco.MjModel, columns: Sequence[Column]) -> list[Guess]:
    """Match controls: goals for position servos, efforts for motors."""
    servos: list[str] = []
    motors: list[str] = []
    for name in model.controlled:
        (servos if compiled.actuator(name).biasprm[1] else motors).append(name)
    found: list[Guess] = []
    for names, wanted in ((servos, _is_goal), (motors, _is_effort)):
        also = [_driven(compiled, model, n) for n in names]
        for told in (True, False):
            used = {g.column for g in found}
            left = [n for n in names if f"ctrl.{n}" not in {g.channel for g in found}]
            some = [c for c in columns if c.commands and c.name not in used]
            some = [c for c in some if wanted(c) is told or (not told)]
            found += match("ctrl", left, some, [also[names.index(n)] for n in left])
    return found


def _last_one(
    model: Model, table: RawTable, columns: Sequence[Column], known: Sequence[Guess]
) -> list[Guess]:
    """Match the only column that is left and changes with the only actuator that has none."""
    used, told = {g.column for g in known}, {g.channel for g in known}
    without = [a for a in model.controlled if f"ctrl.{a}" not in told]
    left = [c for c in columns if c.name not in used and c.kind not in ("time", "velocity")]
    left = [c for c in left if np.ptp(table.column(c.name)) > 0]
    if len(without) != 1 or len(left) != 1:
        return []
    return [Guess(f"ctrl.{without[0]}", left[0].name, left[0].unit, "nothing else is left", 0.3)]


def _is_goal(column: Column) -> bool:
    return column.kind == "command" and not _is_effort(column)


def _is_effort(column: Column) -> bool:
    return bool(WORDS["effort"] & set(column.words)) or column.words[-1:] == ("u",)


def _driven(compiled: mujoco.MjModel, model: Model, actuator: str) -> str:
    a = model.actuators.index(actuator)
    if int(compiled.actuator_trntype[a]) != int(mujoco.mjtTrn.mjTRN_JOINT):
        return actuator
    return str(compiled.joint(int(compiled.actuator_trnid[a, 0])).name)


def _rule(table: RawTable, compiled: mujoco.MjModel, guess: Guess) -> tuple[Rule, Guess]:
    """Return the rule of a guess, and the guess, less sure where a unit was guessed as well."""
    rule: Rule = {} if guess.column == guess.channel else {"from": guess.column}
    kind, element = guess.channel.split(".", 1)
    said = unit(guess.unit, guess.column) if is_unit(guess.unit) else Unit("", "", 1.0)
    fits = said.quantity in _FITS.get(kind, ()) and table.units.get(guess.column) is None
    if kind == "qpos" and said.quantity == "count":
        rule |= _TICK_RULE
    elif fits and (said.factor != 1 or said.quantity in _ELECTRIC):
        rule["unit"] = guess.unit
    elif kind == "qpos" and said.quantity != "angle":
        made, reach = _by_reach(table, compiled, element, guess.column)
        if made:
            reason = f"{guess.reason}; {made['unit']}, since it reaches {reach:.4g}"
            guess = replace(guess, reason=reason, confidence=min(guess.confidence, _UNTOLD))
        rule |= made
    return rule, guess


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
    if int(compiled.jnt_type[place]) != _HINGE:
        return {}, reach
    if whole and reach > 500:
        return _TICK_RULE, reach
    return {"unit": "deg"} if reach > _TURNS and compiled.jnt_limited[place] else {}, reach


def _time(table: RawTable, columns: Sequence[Column]) -> Rule:
    """Return the rule of the clock where it has another name or unit; empty where it is told."""
    clocks = [c for c in columns if c.kind == "time"]
    if table.clocks or not clocks:
        return {}
    clock = clocks[0]
    values = table.column(clock.name)
    step = float(np.median(np.diff(values[np.isfinite(values)])))
    dated = table.columns[clock.name].dtype.kind in "mM"  # read in seconds, however it is called
    named = clock.unit if clock.unit in ("ms", "us", "µs", "ns") and not dated else ""
    if not named and not dated:
        named = next((u for u, f in (("ns", 3e4), ("us", 300.0), ("ms", 0.5)) if step > f), "")
    rule: Rule = {} if clock.name == "time" else {"from": clock.name}
    if named:
        rule["unit"] = named
    return rule
