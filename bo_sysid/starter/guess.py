"""From a model and a log to the rules that read it, each with a reason and a confidence."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import mujoco

from bo_sysid.checks.proposal import Rule
from bo_sysid.errors import RecordingError
from bo_sysid.mjcf import Loops, Model
from bo_sysid.mjcf.joints import BALL, SCALAR
from bo_sysid.mjcf.loops import tied_by
from bo_sysid.recording import RawTable, Recording
from bo_sysid.recording.mapping import to_recording
from bo_sysid.starter.columns import describe, spoilt
from bo_sysid.starter.controls import left_over, matched_controls
from bo_sysid.starter.matching import Guess, match, rates_of
from bo_sysid.starter.naming import Column, named_after
from bo_sysid.starter.pose import pose_guesses, pose_rule
from bo_sysid.starter.reading import clock_rule, column_rule, driven, fits_joint

_BODY = 0.85  # what the name of a joint's body counts, of its own


@dataclass(frozen=True)
class Rules:
    """How a log is to be read.

    Attributes:
        columns: by channel, the rule as it stands in a study.
        clocks: by kind, the clock as it stands in a study.
        guesses: by channel (or ``time``), the reason and the confidence of its rule.
        held: joints that were not recorded, ball joints as well, of a model of which others were.
        missing: all joints, where a column was found for none.
        unmatched: actuators without a column.
        unused: columns that nothing was matched with.
        following: joints that were not recorded and are tied to others, as in a closed chain.
        of_held: channels of the held joints, which a column may be after all.
    """

    columns: Mapping[str, Rule]
    clocks: Mapping[str, Rule]
    guesses: Mapping[str, Guess]
    held: tuple[str, ...]
    missing: tuple[str, ...]
    unmatched: tuple[str, ...]
    unused: tuple[str, ...]
    following: tuple[str, ...] = ()
    of_held: tuple[str, ...] = ()

    @property
    def to_fill_in(self) -> tuple[str, ...]:
        """Channels that the user has to say."""
        joints = (f"qpos.{j}" for j in self.missing)
        return (*joints, *(f"ctrl.{a}" for a in self.unmatched))

    def without_controls(self, actuators: Collection[str]) -> "Rules":
        """Return the rules without those of actuators that a model lacks, as of held joints."""
        out = {f"ctrl.{a}" for a in actuators} & set(self.columns)
        return replace(
            self,
            columns={n: r for n, r in self.columns.items() if n not in out},
            guesses={n: g for n, g in self.guesses.items() if n not in out},
            unmatched=tuple(a for a in self.unmatched if a not in actuators),
            unused=(*self.unused, *(self.guesses[n].column for n in sorted(out))),
        )


def guess_rules(model: Model, table: RawTable) -> Rules:
    """Guess which column is what, by names and by behaviour.

    Args:
        model: the nominal model.
        table: the first log, as a reader returned it.

    Raises:
        RecordingError: there is no hinge, slide or pose of a base to match, the log has no clock,
            or cells that are no numbers hide its positions.
    """
    compiled = model.compile()
    joints = [n for n in model.joints if int(compiled.joint(n).type[0]) in SCALAR]
    columns = describe(table, [*joints, *model.controlled])
    pose = {g.channel: g for g in pose_guesses(compiled, table) if g.channel not in table.columns}
    if not joints and not pose and not set(model.qpos_channels) <= set(table.columns):
        raise RecordingError(
            f"{table.source}: init matches columns with hinges, slides and the pose of a floating "
            f"base, and {model.source} has no hinge or slide, and the log no such pose; write the "
            f"study by hand, with columns like {', '.join(map(repr, model.qpos_channels[:4]))}"
        )
    guesses = {g.channel: g for g in _matched(model, table, columns, joints)}
    positions = any(n.startswith("qpos.") for n in guesses)
    time, stepped = clock_rule(table, columns)
    ruled = {n: column_rule(table, compiled, g) for n, g in guesses.items()}
    rules = {n: rule for n, (rule, _) in ruled.items()}
    guesses = {n: guess for n, (_, guess) in ruled.items()}
    rules |= {n: pose_rule(table, g) for n, g in pose.items()}
    guesses |= pose
    guesses |= {} if stepped is None else {"time": stepped}
    known = (model.qpos_channels, model.qvel_channels, model.act_channels, model.sensor_channels)
    used = {g.column for g in guesses.values()}.union(*known)
    silent = [j for j in joints if positions and f"qpos.{j}" not in guesses]
    loops = Loops.of(compiled, silent)
    following = tuple(n for n in silent if n in loops.joints or tied_by(compiled, n))
    alone = not loops.model.eq_active0.any()  # a ball joint may be what closes a loop
    balls = _silent_balls(model, table) if alone and (positions or pose) else []
    scalar = tuple(j for j in silent if j not in following)
    return Rules(
        {"time": time, **rules} if time else rules,
        {},
        guesses,
        (*scalar, *balls),
        () if positions else tuple(joints),
        tuple(a for a in model.controlled if f"ctrl.{a}" not in guesses),
        tuple(c.name for c in columns if c.kind != "time" and c.name not in used),
        following,
        (*(f"qpos.{j}" for j in scalar), *(f"qpos.{j}.{k}" for j in balls for k in range(4))),
    )


def _matched(
    model: Model, table: RawTable, columns: Sequence[Column], joints: Sequence[str]
) -> list[Guess]:
    """Match joints and actuators with columns.

    Raises:
        RecordingError: cells that are no numbers hide the positions.
    """
    compiled = model.compile()
    positions = _positions(compiled, columns, joints)
    if not positions and (moving := _driven_alone(model, compiled, joints)):
        positions = _positions(compiled, columns, moving)
    if joints and not positions and (bad := spoilt(table)):
        raise RecordingError(
            f"{table.source}: no column looks like the position of a joint of {model.source} "
            f"({', '.join(joints)}); {'; '.join(bad)}"
        )
    velocities = rates_of(table, positions, columns) or match(
        "qvel", [g.channel[5:] for g in positions], [c for c in columns if c.kind == "velocity"]
    )
    commands = matched_controls(model, compiled, columns)
    commands += left_over(model, table, columns, (*positions, *velocities, *commands))
    return [*positions, *velocities, *commands]


def _positions(
    compiled: mujoco.MjModel, columns: Sequence[Column], joints: Sequence[str]
) -> list[Guess]:
    """Match joints with columns of positions."""
    return match(
        "qpos",
        joints,
        [c for c in columns if c.kind == "position" or named_after(joints, c)],
        [_body(compiled, j) for j in joints],
        trust=_BODY,
        fits=partial(fits_joint, compiled),
    )


def _driven_alone(model: Model, compiled: mujoco.MjModel, joints: Sequence[str]) -> list[str]:
    """Return the joints that actuators drive, where all others follow from them; else none.

    A log of a five-bar has the angles of its motors.
    """
    moved = {driven(compiled, f"ctrl.{a}") for a in model.controlled}
    others = [j for j in joints if j not in moved]
    loops = Loops.of(compiled, others)
    if not others or not all(j in loops.joints or tied_by(compiled, j) for j in others):
        return []
    return [j for j in joints if j in moved]


def _silent_balls(model: Model, table: RawTable) -> list[str]:
    """Return the ball joints that no column is called after."""
    compiled = model.compile()
    balls = [n for n in model.joints if int(compiled.joint(n).type[0]) == BALL]
    return [n for n in balls if not any(f"qpos.{n}.{k}" in table.columns for k in range(4))]


def _body(compiled: mujoco.MjModel, joint: str) -> str:
    return str(compiled.body(int(compiled.joint(joint).bodyid[0])).name)


def read(table: RawTable, rules: Rules) -> Recording:
    """Return the table as the rules read it."""
    return to_recording(
        table, rules.columns, rules.clocks, name=table.name or Path(table.source).name or "log"
    )
