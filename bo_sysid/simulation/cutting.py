"""Cutting: from recordings with uneven stamps to windows that a model can predict."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import mujoco
import numpy as np
from jaxtyping import Float, Int

from bo_sysid.arrays import Ctrl
from bo_sysid.effects.learned import ELAPSED
from bo_sysid.errors import RecordingError
from bo_sysid.mjcf import Loops, Model, ParameterLike, room_for_delays
from bo_sysid.mjcf.commands import deaf_controls
from bo_sysid.mjcf.joints import HINGE, SLIDE, quaternions
from bo_sysid.recording import Channel, Recording
from bo_sysid.recording.alignment import control_steps, rounding
from bo_sysid.simulation.activations import activations, set_activations
from bo_sysid.simulation.delays import remembered_steps, without_before
from bo_sysid.simulation.smoothing import smooth
from bo_sysid.simulation.state import State
from bo_sysid.simulation.window_starts import window_starts
from bo_sysid.simulation.windows import Layout, Windows, require_orientations

WARMSTART = "aux.qacc_warmstart"  # recorded only from simulated plants
_ON_STEP = 1e-6  # an instant this close to a step, in steps, is on it
_OPEN = 1e-3  # [m] or [rad] that a loop may stay open without a word


def cut(
    model: Model,
    recordings: Sequence[Recording],
    *,
    horizon: int,
    stride: int | None = None,
    timestep: float | None = None,
    signals: Sequence[str] = (),
    controlled: Sequence[str] = (),
    parameters: Sequence[ParameterLike] = (),
) -> Windows:
    """Cut recordings into windows of `horizon` recorded instants.

    Controls are held between their stamps and averaged over each simulation step; measurements
    are never moved or invented: predictions will be compared at the recorded instants.

    Args:
        model: the model that will predict.
        recordings: what was recorded.
        horizon: number H of instants after each start.
        stride: instants from one start to the next; by default `horizon` (disjoint windows).
        timestep: of the simulation in [s]; by default the model's.
        signals: further held channels that laws read; `ELAPSED` is the time since the recording
            began.
        controlled: actuators whose control a law computes; they need no recorded control.
        parameters: of the model; windows begin with the controls of the longest delays they allow,
            and know of what activations follow where they differ by them.

    Raises:
        RecordingError: a joint or an actuator has no channel, or no window fits.
    """
    compiled = model.compile(room_for_delays(model, parameters), timestep=timestep)
    dt = float(compiled.opt.timestep)
    layout = Layout.of(model, compiled)
    pieces = [
        _cut_one(model, compiled, layout, r, i, horizon, stride or horizon, dt, signals, controlled)
        for i, r in enumerate(recordings)
    ]
    channels = sorted(set().union(*(p.channels for p in pieces)), key=_order(layout))
    steps = max(p.steps for p in pieces)
    joined = _joined([_widened(p, channels, steps) for p in pieces], tuple(channels), dt)
    sources = tuple(recordings) if compiled.na and set_activations(model, parameters) else ()
    return replace(joined, sources=sources)


def _cut_one(
    model: Model,
    compiled: mujoco.MjModel,
    layout: Layout,
    recording: Recording,
    number: int,
    horizon: int,
    stride: int,
    dt: float,
    signals: Sequence[str],
    controlled: Sequence[str],
) -> Windows:
    known = {**layout.qpos, **layout.qvel, **layout.sensor}
    channels = [n for n in recording.channels if n in known and n not in layout.unrecorded]
    _require_units(compiled, recording)
    measured = [n for n in layout.qpos if n not in layout.unrecorded]
    _require(recording, [n for n in measured if n not in recording.channels], "joint position")
    time, table = _merged(recording, channels)
    orientations = quaternions(compiled)
    require_orientations(orientations, recording.name, channels, time, table)
    complete = np.isfinite(table[:, [channels.index(n) for n in measured]]).all(axis=1)
    heard = _heard(model, compiled, controlled)
    inputs = {n: recording.channels[n] for n in (*heard, *signals) if n in recording.channels}
    first, left_out = window_starts(recording.name, time, complete, horizon, stride, inputs)
    rows = first[:, None] + np.arange(1, horizon + 1)
    step, fraction = _on_steps(time, rows, time[first], dt)
    steps = int((step + (fraction > 0)).max()) + _feels(compiled, layout, channels)
    ctrl = controls(model, compiled, recording, time[first], steps, dt, controlled)
    start, note = _start(model, compiled, recording, time, table, channels, first, ctrl)
    start, open_ = _on_loops(model.loops, recording, start)
    if late := remembered_steps(compiled):
        before = time[first] - late * dt
        past = controls(model, compiled, recording, before, late, dt, controlled)
        start = replace(start, past=past)
    observed, delayed = without_before(
        compiled, layout.sensor, recording.name, channels, table[rows], step
    )
    return Windows(
        start=start,
        ctrl=ctrl,
        signals={n: _signal(recording, n, time[first], steps, dt) for n in signals},
        channels=tuple(channels),
        observed=observed,
        step=step,
        fraction=fraction,
        time=time[first],
        recording=np.full(len(first), number),
        timestep=dt,
        notes=note + open_,
        left_out=left_out + delayed,
        quaternions=orientations,
    )


def _heard(model: Model, compiled: mujoco.MjModel, controlled: Sequence[str]) -> list[str]:
    """Return the channels of the controls that act and that no controller writes."""
    return [
        n
        for n, deaf in zip(model.ctrl_channels, deaf_controls(compiled), strict=True)
        if not deaf and n.removeprefix("ctrl.") not in controlled
    ]


def _on_steps(
    time: Float[np.ndarray, " T"],
    rows: Int[np.ndarray, "W H"],
    begin: Float[np.ndarray, " W"],
    dt: float,
) -> tuple[Int[np.ndarray, "W H"], Float[np.ndarray, "W H"]]:
    """Return the step before each instant of a window, and the share of the next until it.

    An instant that lies on a step, up to how times are rounded, is on it.
    """
    steps = (time[rows] - begin[:, None]) / dt
    on_step = _ON_STEP + rounding(time) / dt
    step = np.floor(steps + on_step).astype(int)
    fraction = steps - step
    fraction[np.abs(fraction) < on_step] = 0.0
    return step, fraction


def _feels(compiled: mujoco.MjModel, layout: Layout, channels: Sequence[str]) -> bool:
    """Whether a channel shows forces or accelerations, which at an instant are of a step from it.

    At the last instant of a window they need the control from then on.
    """
    stage = np.repeat(compiled.sensor_needstage, compiled.sensor_dim)
    shown = [int(stage[layout.sensor[n]]) for n in channels if n in layout.sensor]
    return int(mujoco.mjtStage.mjSTAGE_ACC) in shown


def _require(recording: Recording, missing: list[str], what: str) -> None:
    if missing:
        raise RecordingError(
            f"{recording.name}: no channel {missing[0]!r}, the {what} that the model needs; "
            f"{recording.hint(missing[0])}"
        )


def _require_units(compiled: mujoco.MjModel, recording: Recording) -> None:
    """Refuse an angle on a slide and a length on a hinge, where units are said."""
    si = {HINGE: "rad", SLIDE: "m"}
    for j in range(compiled.njnt):
        name, unit = f"qpos.{compiled.joint(j).name}", si.get(int(compiled.jnt_type[j]))
        channel = recording.channels.get(name)
        if unit is not None and channel is not None and channel.unit in {"rad", "m"} - {unit}:
            kind, like = ("slides", "m, mm") if unit == "m" else ("turns", "rad, deg")
            raise RecordingError(
                f"{recording.name}: {name} was read in {channel.unit}, but the joint {kind}; "
                f"columns: {{{name}: {{unit: …}}}} needs a unit like {like}"
            )


def _channel(recording: Recording, name: str) -> Channel:
    _require(recording, [name] if name not in recording.channels else [], "input")
    return recording.channels[name]


def _signal(
    recording: Recording, name: str, start: Float[np.ndarray, " W"], steps: int, dt: float
) -> Float[np.ndarray, "W S"]:
    if name == ELAPSED:
        return np.asarray((start - recording.origin)[:, None] + np.arange(steps) * dt)
    return control_steps(_channel(recording, name), start, steps, dt)


def _merged(
    recording: Recording, channels: list[str]
) -> tuple[Float[np.ndarray, " T"], Float[np.ndarray, "T c"]]:
    """Return the union of the channels' stamps and their samples there, NaN where there is none."""
    time = np.unique(np.concatenate([recording.channels[n].time for n in channels]))
    table = np.full((len(time), len(channels)), np.nan)
    for k, name in enumerate(channels):
        channel = recording.channels[name]
        table[np.searchsorted(time, channel.time), k] = channel.values
    return time, table


def controls(
    model: Model,
    compiled: mujoco.MjModel,
    recording: Recording,
    start: Float[np.ndarray, " W"],
    steps: int,
    dt: float,
    controlled: Sequence[str],
) -> Ctrl:
    """Return the recorded controls of the steps of length `dt` in [s] from each start on."""
    ctrl = np.zeros((len(start), steps, len(model.ctrl_channels)))
    deaf = deaf_controls(compiled)
    for k, name in enumerate(model.ctrl_channels):
        if name in recording.channels:
            ctrl[..., k] = control_steps(recording.channels[name], start, steps, dt)
        elif not deaf[k] and name.removeprefix("ctrl.") not in controlled:
            _require(recording, [name], "control")
    return ctrl


def _start(
    model: Model,
    compiled: mujoco.MjModel,
    recording: Recording,
    time: np.ndarray,
    table: np.ndarray,
    channels: list[str],
    first: Int[np.ndarray, " W"],
    ctrl: Ctrl,
) -> tuple[State, tuple[str, ...]]:
    """Return the recorded states; velocities that were not recorded come from a smoother.

    Joints that nothing measures are at rest where the model puts them.
    """
    positions = np.tile(compiled.qpos0, (len(table), 1))
    for k, name in enumerate(model.qpos_channels):
        if name in channels:
            positions[:, k] = table[:, channels.index(name)]
    qpos = positions[first]
    notes: tuple[str, ...] = ()
    at_rest = [n.removeprefix("qvel.") in model.unrecorded for n in model.qvel_channels]
    recorded = [n in channels for n in model.qvel_channels]
    qvel = np.zeros((len(first), compiled.nv))
    for k, name in enumerate(model.qvel_channels):
        if recorded[k]:
            qvel[:, k] = table[first, channels.index(name)]
    if not np.logical_or(recorded, at_rest).all() or np.isnan(qvel).any():
        have = np.isfinite(positions).all(axis=1)
        rank = np.cumsum(have) - 1
        fit = smooth(compiled, time[have], positions[have], rank[first])
        kept = (np.array(recorded) & np.isfinite(qvel)) | np.array(at_rest)
        qvel = np.where(kept, qvel, fit.velocity)
        if not any(recorded):  # the smoother's position belongs to the smoother's velocity
            zero = np.zeros((len(first), compiled.nv))
            state = State(qpos, zero, np.zeros((len(first), 0)))
            qpos = state.moved(compiled, np.hstack([fit.offset, zero])).qpos
        notes = (
            f"{recording.name}: start velocities are estimated from {fit.samples} samples each",
        )
    act = activations(model, compiled, recording, time[first], ctrl)
    return State(qpos, qvel, act, _warmstart(compiled, recording, time[first])), notes


def _on_loops(loops: Loops, recording: Recording, start: State) -> tuple[State, tuple[str, ...]]:
    """Return the states with their loops closed, and what is to be said of that.

    States that were recorded whole, as those of a simulated plant, stay as they are.
    """
    whole = all(f"qvel.{j}" in recording.channels for j in loops.joints)
    if not loops or (whole and not loops.silent):
        return start, ()
    if loops.silent:
        start = replace(start, qpos=loops.followed(start.qpos))
    start = start.closed(loops)
    which = " and ".join(loops.joints)
    note = f"{which} begin where the model's equalities put them"
    opening = float(loops.opening(start.qpos).max())
    if opening > _OPEN:
        return start, (
            f"{recording.name}: {note}, which stay open by up to {opening:.2g} m or rad: are the "
            "zeros and signs of the other joints right, and the lengths of the links?",
        )
    return start, (f"{recording.name}: {note}",)


def _warmstart(
    compiled: mujoco.MjModel, recording: Recording, start: Float[np.ndarray, " W"]
) -> Float[np.ndarray, "W nv"] | None:
    names = [f"{WARMSTART}.{k}" for k in range(compiled.nv)]
    if any(n not in recording.channels for n in names):
        return None
    return np.stack([recording.channels[n].at(start) for n in names], axis=1)


def _order(layout: Layout) -> Callable[[str], int]:
    rank = {n: i for i, n in enumerate([*layout.qpos, *layout.qvel, *layout.sensor])}
    return rank.__getitem__


def _widened(windows: Windows, channels: list[str], steps: int) -> Windows:
    """Return the windows with all channels and a common number of steps (the last one held)."""
    extra = steps - windows.steps
    observed = np.full((*windows.observed.shape[:2], len(channels)), np.nan)
    observed[..., [channels.index(n) for n in windows.channels]] = windows.observed
    return replace(
        windows,
        ctrl=np.pad(windows.ctrl, ((0, 0), (0, extra), (0, 0)), mode="edge"),
        signals={
            n: np.pad(s, ((0, 0), (0, extra)), mode="edge") for n, s in windows.signals.items()
        },
        observed=observed,
    )


def _joined(pieces: Sequence[Windows], channels: tuple[str, ...], dt: float) -> Windows:
    return Windows(
        start=State.concatenated([p.start for p in pieces]),
        ctrl=np.concatenate([p.ctrl for p in pieces]),
        signals={n: np.concatenate([p.signals[n] for p in pieces]) for n in pieces[0].signals},
        channels=channels,
        observed=np.concatenate([p.observed for p in pieces]),
        step=np.concatenate([p.step for p in pieces]),
        fraction=np.concatenate([p.fraction for p in pieces]),
        time=np.concatenate([p.time for p in pieces]),
        recording=np.concatenate([p.recording for p in pieces]),
        timestep=dt,
        notes=tuple(n for p in pieces for n in p.notes),
        left_out=tuple(n for p in pieces for n in p.left_out),
        quaternions=pieces[0].quaternions,
    )
