"""Windows: pieces of recordings with a start, the controls of every step, and what was observed."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

from bo_sysid.arrays import Ctrl
from bo_sysid.errors import RecordingError
from bo_sysid.mjcf import Model
from bo_sysid.mjcf.joints import BALL, FREE
from bo_sysid.recording import Recording
from bo_sysid.simulation.state import State, Trajectory

_UNIT = 0.1  # by which the length of a quaternion may differ from 1
_USUALLY = 0.01  # the same, of most of a log: more is a scale


@dataclass(frozen=True)
class Windows:
    """W windows of H recorded instants, cut for a model.

    Attributes:
        start: the state at the start of each window.
        ctrl: `W x S x nu` controls of each simulation step.
        signals: further inputs by channel name (goals, auxiliary), each `W x S`.
        channels: names of the c observed channels.
        observed: `W x H x c` measurements; NaN where a channel has none at an instant.
        step: `W x H` simulation step at or before each instant.
        fraction: `W x H` how far into the next step the instant lies, 0 to 1.
        time: `W` start times in [s], on the recording's clock.
        recording: `W` number of the recording that each window comes from.
        timestep: of the simulation, in [s].
        notes: what was done to cut them.
        left_out: what of the recordings is in no window, in words.
        sources: the recordings, where activations at the starts differ by parameters.
        quaternions: the four channels of each orientation that the model has.
    """

    start: State
    ctrl: Ctrl
    signals: Mapping[str, Float[np.ndarray, "W S"]]
    channels: tuple[str, ...]
    observed: Float[np.ndarray, "W H c"]
    step: Int[np.ndarray, "W H"]
    fraction: Float[np.ndarray, "W H"]
    time: Float[np.ndarray, " W"]
    recording: Int[np.ndarray, " W"]
    timestep: float
    notes: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    sources: tuple[Recording, ...] = field(default=(), repr=False)
    quaternions: tuple[tuple[str, ...], ...] = ()

    def __len__(self) -> int:
        return len(self.time)

    @property
    def steps(self) -> int:
        """Number S of simulation steps."""
        return int(self.ctrl.shape[1])

    @property
    def aligned(self) -> bool:
        """Whether all windows are observed at one common set of whole steps."""
        return not self.fraction.any() and bool((self.step == self.step[0]).all())

    def rows(self, index: np.ndarray | slice) -> "Windows":
        """Return some of the windows."""
        return replace(
            self,
            start=self.start.rows(index),
            ctrl=self.ctrl[index],
            signals={name: s[index] for name, s in self.signals.items()},
            observed=self.observed[index],
            step=self.step[index],
            fraction=self.fraction[index],
            time=self.time[index],
            recording=self.recording[index],
        )

    def beginning(self, instants: int) -> "Windows":
        """Return the first instants of every window."""
        at = self.step + self.fraction
        last, first = (int(np.ceil(a.max() - 1e-9)) for a in (at, at[:, :instants]))
        steps = self.steps - last + first  # what the last instant needs beyond it stays
        return replace(
            self,
            ctrl=self.ctrl[:, :steps],
            signals={name: s[:, :steps] for name, s in self.signals.items()},
            observed=self.observed[:, :instants],
            step=self.step[:, :instants],
            fraction=self.fraction[:, :instants],
        )

    def arranged(self, order: Int[np.ndarray, "W n"], seen: Bool[np.ndarray, "W n"]) -> "Windows":
        """Return the windows with other instants: those at `order`, observed where `seen`."""
        row = np.arange(len(self))[:, None]
        return replace(
            self,
            observed=np.where(seen[..., None], self.observed[row, order], np.nan),
            step=self.step[row, order],
            fraction=self.fraction[row, order],
        )

    def among(self, channels: Collection[str]) -> "Windows":
        """Return the windows with those of their observed channels that are among `channels`."""
        kept = [k for k, name in enumerate(self.channels) if name in channels]
        names = tuple(self.channels[k] for k in kept)
        return replace(self, channels=names, observed=self.observed[..., kept])

    def evenly(self, most: int) -> Int[np.ndarray, " k"]:
        """Return the rows of at most so many windows, evenly spread over all."""
        return np.unique(np.linspace(0, len(self) - 1, min(most, len(self))).astype(int))

    def with_start(self, start: State) -> "Windows":
        """Return the same windows from other starts."""
        return replace(self, start=start)

    def residual(self, predicted: Float[np.ndarray, "W H c"]) -> Float[np.ndarray, "W H c"]:
        """Return observed minus predicted; a quaternion is compared with its nearer sign."""
        observed = self.observed * self.signs(predicted) if self.quaternions else self.observed
        return np.asarray(observed - predicted)

    def signs(self, predicted: Float[np.ndarray, "W H c"]) -> Float[np.ndarray, "W H c"]:
        """Return with which sign each observation is nearer to a prediction: 1 but for quaternions.

        A body's orientation is q as well as -q, and loggers change over from one to the other.
        """
        found = np.ones(self.observed.shape)
        for names in self.quaternions:
            if not set(names) <= set(self.channels):
                continue  # not recorded whole
            own = [self.channels.index(n) for n in names]
            dot = (self.observed[..., own] * predicted[..., own]).sum(axis=-1, keepdims=True)
            found[..., own] = np.where(dot < 0, -1.0, 1.0)
        return found


@dataclass(frozen=True)
class Layout:
    """Where a model keeps each channel of the column convention.

    Attributes:
        qpos: column of `qpos` by channel name.
        qvel: column of `qvel` by channel name.
        sensor: column of `sensordata` by channel name.
        velocity: for each column of `qpos`, the column of `qvel` that is its rate, or -1 for
            the coordinates of a quaternion.
        unrecorded: channels of the joints that nothing measures.
        also: columns of the joints that a channel of a position or velocity shows as well.
        turns: for each channel of a quaternion, the columns of `qpos` and `qvel` where the
            quaternion and its angular velocity begin, and which of its numbers the channel is.
    """

    qpos: Mapping[str, int]
    qvel: Mapping[str, int]
    sensor: Mapping[str, int]
    velocity: Int[np.ndarray, " nq"]
    unrecorded: frozenset[str] = frozenset()
    also: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    turns: Mapping[str, tuple[int, int, int]] = field(default_factory=dict)

    @classmethod
    def of(cls, model: Model, compiled: mujoco.MjModel) -> "Layout":
        """Return the layout of a model."""
        rate = np.full(compiled.nq, -1)
        turned: dict[int, tuple[int, int, int]] = {}
        for j in range(compiled.njnt):
            q, v = int(compiled.jnt_qposadr[j]), int(compiled.jnt_dofadr[j])
            kind = int(compiled.jnt_type[j])
            if kind == FREE:
                rate[q : q + 3] = np.arange(v, v + 3)
                turned |= {q + 3 + i: (q + 3, v + 3, i) for i in range(4)}
            elif kind == BALL:
                turned |= {q + i: (q, v, i) for i in range(4)}
            else:
                rate[q] = v
        qpos = {name: i for i, name in enumerate(model.qpos_channels)}
        qvel = {name: i for i, name in enumerate(model.qvel_channels)}
        also: dict[str, tuple[int, ...]] = {}
        for hidden, shown_by in model.unrecorded.items():
            for group, columns in (("qpos", qpos), ("qvel", qvel)):
                if shown_by is not None:
                    shows = f"{group}.{shown_by}"
                    also[shows] = (*also.get(shows, ()), columns[f"{group}.{hidden}"])
        return cls(
            qpos,
            qvel,
            {name: i for i, name in enumerate(model.sensor_channels)},
            rate,
            frozenset(f"{g}.{n}" for n in model.unrecorded for g in ("qpos", "qvel")),
            also,
            {name: turned[i] for name, i in qpos.items() if i in turned},
        )


def require_recorded_joint(name: str, channels: Sequence[str], unrecorded: Iterable[str]) -> None:
    """Refuse a recording with nothing to compare, since the study names its joints as unrecorded.

    Args:
        name: of the recording.
        channels: that are compared.
        unrecorded: joints that nothing measures.

    Raises:
        RecordingError: there is no channel; the message names the key of the study and its joints.
    """
    if not channels:
        raise RecordingError(
            f"{name}: no joint is left that was recorded: model: {{unrecorded: …}} of the study "
            f"names {', '.join(unrecorded)}; leave out of it what was recorded"
        )


def require_orientations(
    orientations: Sequence[Sequence[str]],
    name: str,
    channels: Sequence[str],
    time: Float[np.ndarray, " T"],
    table: Float[np.ndarray, "T c"],
) -> None:
    """Refuse quaternions that are no orientation, as those written before one is known.

    Args:
        orientations: the four channels of each.
        name: of the recording.
        channels: of the columns of `table`.
        time: `T` instants in [s].
        table: what was measured; NaN where nothing was.

    Raises:
        RecordingError: a length is far from 1; the message names channels, time and remedy.
    """
    for names in orientations:
        if not set(names) <= set(channels):
            continue  # not recorded whole
        length = np.linalg.norm(table[:, [channels.index(n) for n in names]], axis=1)
        usual = float(np.nanmedian(length)) if np.isfinite(length).any() else 1.0
        scaled = abs(usual - 1.0) > _USUALLY
        wrong = np.flatnonzero(np.abs(length - 1.0) > (_USUALLY if scaled else _UNIT))
        if not wrong.size:
            continue
        first, last = names[0], names[-1]
        remedy = "leave such rows out of the log"
        if usual > 0 and scaled:
            remedy = f"columns: {{{first}: {{scale: {1 / usual:.6g}}}}}, and so for all four"
        raise RecordingError(
            f"{name}: {first} to {last} are a quaternion of length {length[wrong[0]]:.4g} at "
            f"{time[wrong[0]]:g} s; an orientation has length 1 ({wrong.size} of "
            f"{np.isfinite(length).sum()} have another): {remedy}"
        )


def predicted(
    layout: Layout, windows: Windows, trajectory: Trajectory
) -> Float[np.ndarray, "W H c"]:
    """Return what a trajectory predicts for the observed channels at the recorded instants.

    Between two steps a position moves as under the step's mean acceleration,
    q(s) = q0 + s (q1 - q0) - s (1 - s) h (v1 - v0) / 2 with 0 <= s <= 1, which meets both ends
    under any integrator; velocities, sensors and quaternions are linear in s.

    Args:
        layout: of the model that made the trajectory.
        windows: gives channels and instants.
        trajectory: of the same W windows.
    """
    out = np.empty((len(windows), windows.step.shape[1], len(windows.channels)))
    row = np.arange(len(windows))[:, None]
    now, s = windows.step, windows.fraction
    between = bool(s.any())
    after = np.minimum(now + 1, trajectory.qpos.shape[1] - 1) if between else now
    for k, name in enumerate(windows.channels):
        values, v = _shown(layout, name, trajectory)
        out[..., k] = values[row, now]
        if between:
            out[..., k] += s * (values[row, after] - values[row, now])
            if v is not None:
                bend = 0.5 * s * (1 - s) * windows.timestep
                out[..., k] -= bend * (v[row, after] - v[row, now])
    return out


def _shown(
    layout: Layout, name: str, trajectory: Trajectory
) -> tuple[Float[np.ndarray, "W S1"], Float[np.ndarray, "W S1"] | None]:
    """Return what a channel shows at every step, and its rate where that is known."""
    more = layout.also.get(name, ())
    if name in layout.qpos:
        column = layout.qpos[name]
        values, turns = trajectory.qpos[..., column], int(layout.velocity[column])
        rate = trajectory.qvel[..., turns] if turns >= 0 else None
        for k in more:  # hinges and slides, as the joint that shows them
            values = values + trajectory.qpos[..., k]
            rate = None if rate is None else rate + trajectory.qvel[..., int(layout.velocity[k])]
        return values, rate
    if name in layout.qvel:
        values = trajectory.qvel[..., layout.qvel[name]]
        for k in more:
            values = values + trajectory.qvel[..., k]
        return values, None
    assert trajectory.sensordata is not None  # noqa: S101 - asked for by the caller
    return trajectory.sensordata[..., layout.sensor[name]], None
