"""A plant of the benchmark of the diagnosis: the nominal model with physics that it lacks.

It is stepped at 50 us; friction may be LuGre instead of Coulomb, laws that are in no catalogue may
act, and the log may be slow, fast or uneven.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from diagnosis_rigs import Log, Rig, excitation

from bo_sysid.effects import CATALOGUE, Filter, Force, Hidden, Machine, Reading, Site
from bo_sysid.mjcf import Model
from bo_sysid.recording import Channel, Recording

_STEP = 5e-5  # [s] of a plant, a fortieth of the models'; less where the log is faster
_BRISTLES = 2  # times finer still, where bristles bend by .2 mrad within a step


@dataclass(frozen=True)
class Planted:
    """An effect that a plant has: id, site, magnitudes, size in sigma, value as it is reported."""

    effect: str
    kind: str
    site: str
    x: tuple[float, ...]
    size: float = 0.0
    value: float = 0.0


def simulate(
    model: Model,
    rig: Rig,
    machine: Machine | None,
    truth: Sequence[Planted],
    *,
    seed: int,
    duration: float,
    sigma: float,
    log: Log | None = None,
    lugre: bool = False,
    strange: Sequence[Force] = (),
) -> Recording:
    """Return a recording of noisy joint positions and of the controls that were commanded.

    The command changes when a row is written.
    """
    log = log or Log(rig.sampling)
    rng = np.random.default_rng(seed)
    parts: list[object] = list(strange)

    def edit(spec: mujoco.MjSpec) -> None:
        for p in truth:
            assert machine is not None
            if lugre and p.effect == "dry_friction":
                _lugre(spec, p.site, p.x[0])
                continue
            effect = CATALOGUE[p.effect]
            parts.extend(effect.parts(spec, Site(p.kind, p.site), np.array(p.x), machine))

    finer = max(round(log.sampling / _STEP), 8) * (_BRISTLES if lugre else 1)
    compiled = model.compile([edit], timestep=log.sampling / finer)
    data = mujoco.MjData(compiled)
    tick = np.arange(round(duration / log.sampling)) * finer
    early = int(log.jitter * finer)
    if early:
        tick[1:] += rng.integers(-early, early + 1, len(tick) - 1)
    time = tick * compiled.opt.timestep
    goal = excitation(rng, rig, time)
    if rig.middle:
        goal += np.array(rig.middle)
        data.qpos[_Encoders(model, compiled, parts).qpos] = goal[0]
    commanded, position = _run(model, compiled, data, rig, tick, goal, parts, rng, sigma)
    shown = _shown(model, compiled.opt.timestep, tick, position, parts)
    shown += sigma * rng.normal(size=shown.shape)
    return Recording.from_arrays(
        time,
        name=f"recording {seed}",
        qpos={n: shown[:, i] for i, n in enumerate(model.joints)},
        ctrl={n: commanded[:, i] for i, n in enumerate(model.actuators)},
    )


def _run(model, compiled, data, rig, tick, goal, parts, rng, sigma):
    """Step the plant; filters act on the command at the plant's own step."""
    fine = compiled.opt.timestep
    time, ends = tick * fine, np.append(tick[1:], 2 * tick[-1] - tick[-2])
    filters = [p for p in parts if isinstance(p, Filter)]
    offsets = {p.channel: p.offset for p in parts if isinstance(p, Reading)}
    laws = [p for p in parts if hasattr(p, "law")]
    encoders = _Encoders(model, compiled, parts)
    position = np.zeros((ends[-1], len(model.joints)))
    commanded = np.zeros((len(tick), len(model.actuators)))
    if rig.gains is None:
        commanded = goal
        applied = _filtered(model, time, goal, filters, fine, ends[-1])
    else:
        kp, kd = (np.array(g) for g in rig.gains)
        gear = compiled.actuator_gear[: len(model.actuators), 0]
        past = _Causal(model, filters, time, fine)
        zero = np.array([offsets.get(f"qpos.{n}", 0.0) for n in model.joints])
    for k, (begin, end) in enumerate(zip(tick, ends, strict=True)):
        if rig.gains is None:
            acting = applied[begin:end]
        else:
            shown, speed = encoders.read(data)
            seen = shown + zero + sigma * rng.normal(size=len(shown))
            u = (kp * (goal[k] - seen) - kd * speed) / gear
            commanded[k] = u
            acting = past(commanded, k, np.arange(begin, end))
        for at in range(begin, end):
            position[at] = encoders.read(data)[0]
            data.ctrl[: acting.shape[1]] = acting[at - begin]
            data.qfrc_applied[:] = 0
            view = _View(model, encoders, data, at * fine, fine) if laws else None
            for law in laws:
                j = encoders.qvel[model.joints.index(law.joint)]
                data.qfrc_applied[j] += float(np.asarray(law.law(view)).ravel()[0])
            mujoco.mj_step(compiled, data)
    return commanded, position


class _Encoders:
    """Where a plant, which may have more joints, keeps those of the model, and what is read."""

    def __init__(self, model: Model, compiled: mujoco.MjModel, parts: Sequence[object]) -> None:
        self.qpos = [int(compiled.joint(n).qposadr[0]) for n in model.joints]
        self.qvel = [int(compiled.joint(n).dofadr[0]) for n in model.joints]
        added = [p for p in parts if isinstance(p, Hidden)]
        self.added = [(model.joints.index(p.of), compiled.joint(p.joint), p.shown) for p in added]
        self.hidden = {p.joint: compiled.joint(p.joint) for p in added}

    def read(self, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
        qpos, qvel = data.qpos[self.qpos], data.qvel[self.qvel]
        for i, joint, shown in self.added:
            qpos[i] += shown * data.qpos[joint.qposadr[0]]
            qvel[i] += shown * data.qvel[joint.dofadr[0]]
        return qpos, qvel


class _View:
    """What a law sees of the plant."""

    def __init__(
        self,
        model: Model,
        encoders: _Encoders,
        data: mujoco.MjData,
        time: float,
        timestep: float,
    ) -> None:
        self.time, self.timestep = np.array([time]), timestep
        self.qpos = {n: data.qpos[[i]] for n, i in zip(model.joints, encoders.qpos, strict=True)}
        self.qvel = {n: data.qvel[[i]] for n, i in zip(model.joints, encoders.qvel, strict=True)}
        for name, joint in encoders.hidden.items():  # a law may act on what no encoder shows
            self.qpos[name] = data.qpos[joint.qposadr]
            self.qvel[name] = data.qvel[joint.dofadr]
        self.ctrl = {n: data.ctrl[i : i + 1] for i, n in enumerate(model.actuators)}
        self.act = {
            n: data.act[a : a + 1]
            for n in model.actuators
            if (a := int(data.model.actuator(n).actadr[0])) >= 0
        }


def _filtered(model, time, goal, filters, fine, count) -> np.ndarray:
    grid = np.arange(count) * fine
    out = np.zeros((len(grid), goal.shape[1]))
    for a, name in enumerate(model.actuators):
        channel = Channel(time, goal[:, a], hold="zero")
        for f in filters:
            if f.actuator == name:
                channel = f.change(channel, fine)
        out[:, a] = channel.at(grid + 1e-9)
    return out


class _Causal:
    """Applies filters to a command that is only known up to now."""

    def __init__(
        self, model: Model, filters: Sequence[Filter], time: np.ndarray, fine: float
    ) -> None:
        self.model, self.filters, self.time, self.fine = model, filters, time, fine
        self.span = 200

    def __call__(self, commanded: np.ndarray, k: int, at: np.ndarray) -> np.ndarray:
        """Return what acts at the steps `at` within row `k`, one row a step."""
        now = np.tile(commanded[k], (len(at), 1))
        first = max(k - self.span, 0)
        for f in self.filters:
            a = self.model.actuators.index(f.actuator)
            later = 2 * self.time[k] - self.time[k - 1] if k else self.time[1]
            time = np.append(self.time[first : k + 1], later)
            values = np.append(commanded[first : k + 1, a], commanded[k, a])
            changed = f.change(Channel(time, values, hold="zero"), self.fine)
            now[:, a] = changed.at(at * self.fine + 1e-9)
        return now


def _shown(model, fine, tick, position, parts) -> np.ndarray:
    grid, out = np.arange(len(position)) * fine, position[tick]
    for r in parts:
        if isinstance(r, Reading) and r.channel.startswith("qpos."):
            i = model.joints.index(r.channel.removeprefix("qpos."))
            late = np.interp(tick * fine - r.delay, grid, position[:, i])
            out[:, i] = (1 + r.scale) * late + r.offset
    return out


def _lugre(spec: mujoco.MjSpec, joint: str, level: float) -> None:
    """Friction as a bristle: the same Coulomb level, presliding instead of a step."""
    motor = spec.add_actuator(
        name=f"{joint}_lugre", trntype=mujoco.mjtTrn.mjTRN_JOINT, target=joint,
        dyntype=mujoco.mjtDyn.mjDYN_DCMOTOR, gaintype=mujoco.mjtGain.mjGAIN_DCMOTOR,
        biastype=mujoco.mjtBias.mjBIAS_DCMOTOR,
    )  # fmt: skip
    motor.ctrlspec, motor.actearly, motor.actdim = 16, True, 1
    motor.gainprm[:2] = (1.0, 1e-6)
    dynamics = np.zeros(10)
    dynamics[5:7] = (level / 2e-4, 0.2 * np.sqrt(level / 2e-4) * 0.05)
    motor.dynprm = dynamics
    motor.biasprm[3:6] = (level, level, 0.05)
