"""Cutting: from recordings with uneven stamps to windows that a model can predict."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from jaxtyping import Float, Int

from bo_sysid.arrays import Ctrl
from bo_sysid.effects.learned import ELAPSED
from bo_sysid.errors import RecordingError
from bo_sysid.mjcf import Model, ParameterLike, room_for_delays
from bo_sysid.mjcf.commands import controls_without_gain
from bo_sysid.mjcf.joints import HINGE, SLIDE, quaternions
from bo_sysid.recording import Channel, Recording
from bo_sysid.recording.alignment import control_steps, rounding
from bo_sysid.simulation.activations import memory_of, set_activations
from bo_sysid.simulation.delays import mask_pre_window_samples, remembered_steps
from bo_sysid.simulation.recorded_starts import on_loops, recorded_start
from bo_sysid.simulation.state import State
from bo_sysid.simulation.window_starts import window_starts
from bo_sysid.simulation.windows import (
    Layout,
    Windows,
    require_orientations,
    require_recorded_joint,
)

_ON_STEP = 1e-6  # an instant this close to a step, in steps, is on it


def cut(
    model: Model,
    recordings: Sequence[Recording],
    *,
    horizon: int | Sequence[int],
    stride: int | Sequence[int] | None = None,
    timestep: float | None = None,
    signals: Sequence[str] = (),
    controlled: Sequence[str] = (),
    parameters: Sequence[ParameterLike] = (),
) -> Windows:
    """Cut recordings into windows of `horizon` recorded instants.

    Recordings of different rates may have horizons of their own. The shorter windows stay at their
    last instant then, and nothing is observed there any more.

    Controls are held between their stamps and averaged over each simulation step; measurements
    are never moved or invented: predictions will be compared at the recorded instants.

    Args:
        model: the model that will predict.
        recordings: what was recorded.
        horizon: number H of instants after each start, or one number for each recording.
        stride: instants from one start to the next, of all or of each recording; by default
            `horizon` (disjoint windows).
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
    layout = Layout.of(model, compiled)
    horizons = [horizon] * len(recordings) if isinstance(horizon, int) else horizon
    strides = [stride] * len(recordings) if isinstance(stride, int) else stride or horizons
    pieces = []
    for number, (recording, own, apart) in enumerate(
        zip(recordings, horizons, strides, strict=True)
    ):
        cutter = _Cutter(model, compiled, layout, own, apart, tuple(signals), tuple(controlled))
        pieces.append(cutter.cut(recording, number))
    channels = sorted(set().union(*(p.channels for p in pieces)), key=_order(layout))
    steps = max(p.steps for p in pieces)
    joined = _joined(
        [_widened(p, channels, steps, max(horizons)) for p in pieces],
        tuple(channels),
        float(compiled.opt.timestep),
    )
    sources = tuple(recordings) if compiled.na and set_activations(model, parameters) else ()
    return replace(joined, sources=sources)


@dataclass(frozen=True)
class _Cutter:
    """Cuts a recording; see `cut` for what it takes."""

    model: Model
    compiled: mujoco.MjModel
    layout: Layout
    horizon: int
    stride: int
    signals: tuple[str, ...]
    controlled: tuple[str, ...]

    @property
    def dt(self) -> float:
        """Time step of the simulation in [s]."""
        return float(self.compiled.opt.timestep)

    def cut(self, recording: Recording, number: int) -> Windows:
        """Return the windows of a recording, which is to be known by a number."""
        compiled, dt = self.compiled, self.dt
        channels, time, table = self._observed(recording)
        first, left_out = self._first(recording, channels, time, table)
        rows = first[:, None] + np.arange(1, self.horizon + 1)
        step, fraction = _on_steps(time, rows, time[first], dt)
        steps = int((step + (fraction > 0)).max()) + _shows_acceleration(
            compiled, self.layout, channels
        )
        ctrl = controls(self.model, compiled, recording, time[first], steps, dt, self.controlled)
        start, notes = self._start(recording, channels, time, table, first, ctrl)
        observed, delayed = mask_pre_window_samples(
            compiled, self.layout.sensor, recording.name, channels, table[rows], step
        )
        return Windows(
            start=start,
            ctrl=ctrl,
            signals={n: _signal(recording, n, time[first], steps, dt) for n in self.signals},
            channels=tuple(channels),
            observed=observed,
            step=step,
            fraction=fraction,
            time=time[first],
            recording=np.full(len(first), number),
            timestep=dt,
            notes=notes,
            left_out=left_out + delayed,
            quaternions=quaternions(compiled),
        )

    @property
    def _measured(self) -> list[str]:
        """The positions that are needed."""
        return [n for n in self.layout.qpos if n not in self.layout.unrecorded]

    def _observed(
        self, recording: Recording
    ) -> tuple[list[str], Float[np.ndarray, " T"], Float[np.ndarray, "T c"]]:
        """Return the channels that are compared, all instants of theirs, and their values."""
        layout = self.layout
        known = {**layout.qpos, **layout.qvel, **layout.sensor}
        channels = [n for n in recording.channels if n in known and n not in layout.unrecorded]
        _require_units(self.compiled, recording)
        missing = [n for n in self._measured if n not in recording.channels]
        _require(recording, missing, "joint position")
        require_recorded_joint(recording.name, channels, self.model.unrecorded)
        time, table = _merged(recording, channels)
        require_orientations(quaternions(self.compiled), recording.name, channels, time, table)
        return channels, time, table

    def _first(
        self,
        recording: Recording,
        channels: Sequence[str],
        time: Float[np.ndarray, " T"],
        table: Float[np.ndarray, "T c"],
    ) -> tuple[Int[np.ndarray, " W"], tuple[str, ...]]:
        """Return the rows at which windows begin, and what was left out, in words."""
        columns = [channels.index(n) for n in self._measured]
        complete = np.isfinite(table[:, columns]).all(axis=1)
        acting = _acting_controls(self.model, self.compiled, self.controlled)
        names = (*acting, *self.signals)
        inputs = {n: recording.channels[n] for n in names if n in recording.channels}
        memory = memory_of(self.model, self.compiled, recording)
        return window_starts(
            recording.name, time, complete, self.horizon, self.stride, inputs, memory
        )

    def _start(
        self,
        recording: Recording,
        channels: Sequence[str],
        time: Float[np.ndarray, " T"],
        table: Float[np.ndarray, "T c"],
        first: Int[np.ndarray, " W"],
        ctrl: Ctrl,
    ) -> tuple[State, tuple[str, ...]]:
        """Return where the windows begin, and what is to be known of that, in words."""
        model, compiled, dt = self.model, self.compiled, self.dt
        start, note = recorded_start(model, compiled, recording, time, table, channels, first, ctrl)
        start, open_ = on_loops(model.loops, recording, start)
        if late := remembered_steps(compiled):
            before = time[first] - late * dt
            past = controls(model, compiled, recording, before, late, dt, self.controlled)
            start = replace(start, past=past)
        return start, note + open_


def _acting_controls(
    model: Model, compiled: mujoco.MjModel, controlled: Sequence[str]
) -> list[str]:
    """Return the channels of the controls that act and that no controller writes."""
    return [
        n
        for n, without_gain in zip(
            model.ctrl_channels, controls_without_gain(compiled), strict=True
        )
        if not without_gain and n.removeprefix("ctrl.") not in controlled
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


def _shows_acceleration(compiled: mujoco.MjModel, layout: Layout, channels: Sequence[str]) -> bool:
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
    """Refuse an angle on a slide and a length on a hinge, where units are stated."""
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
    without_gain = controls_without_gain(compiled)
    for k, name in enumerate(model.ctrl_channels):
        if name in recording.channels:
            ctrl[..., k] = control_steps(recording.channels[name], start, steps, dt)
        elif not without_gain[k] and name.removeprefix("ctrl.") not in controlled:
            _require(recording, [name], "control")
    return ctrl


def _order(layout: Layout) -> Callable[[str], int]:
    rank = {n: i for i, n in enumerate([*layout.qpos, *layout.qvel, *layout.sensor])}
    return rank.__getitem__


def _widened(windows: Windows, channels: list[str], steps: int, horizon: int) -> Windows:
    """Return the windows with all channels, and as many steps and instants (the last ones held)."""
    extra, (count, own, _) = steps - windows.steps, windows.observed.shape
    observed = np.full((count, horizon, len(channels)), np.nan)
    observed[:, :own, [channels.index(n) for n in windows.channels]] = windows.observed
    held = ((0, 0), (0, horizon - own))
    return replace(
        windows,
        ctrl=np.pad(windows.ctrl, ((0, 0), (0, extra), (0, 0)), mode="edge"),
        signals={
            n: np.pad(s, ((0, 0), (0, extra)), mode="edge") for n, s in windows.signals.items()
        },
        observed=observed,
        step=np.pad(windows.step, held, mode="edge"),
        fraction=np.pad(windows.fraction, held, mode="edge"),
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
