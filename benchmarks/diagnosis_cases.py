"""Machines and drawn cases for the benchmark of the diagnosis.

A plant is the nominal model with effects in it, stepped at a quarter of a millisecond; friction
may be LuGre instead of Coulomb, and the log may be slow, fast or uneven. Sizes are drawn
log-uniformly by what they do to the predictions: the projected rms difference over windows of
0.3 s (0.1 s in contact), in units of the sensor noise. What a case counts as is what its effects do
in its own training recording: a limit that is never reached says nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import mujoco
import numpy as np

from bo_sysid.diagnosis.hypothesis import Candidate, Hypothesis, candidates
from bo_sysid.diagnosis.linear import project
from bo_sysid.diagnosis.problem import pose
from bo_sysid.diagnosis.windowing import nothing, prepare
from bo_sysid.effects import CATALOGUE, Filter, Force, Hidden, Machine, Reading, Site, survey
from bo_sysid.mjcf import Model
from bo_sysid.mjcf.touching import can_touch
from bo_sysid.recording import Channel, Recording
from bo_sysid.simulation import Engine

MODELS = Path(__file__).parents[1] / "studies" / "diagnosis"
_STEP = 2.5e-4  # [s] of a plant, an eighth of the models'; less where the log is faster
_BRISTLES = 8  # times finer still, where bristles bend by .2 mrad within a step
_WINDOW = 0.3  # [s] in which an effect is sized
_TOUCHING = 0.1  # [s] the same where geoms can touch
_NO_SIZE = 1e-3  # [sigma]
_ALIKE = 0.98  # cosine of the differences that two effects make, that is one effect
_TRIES = 40  # draws until every effect of a case can be sized


@dataclass(frozen=True)
class Rig:
    """A machine with the way it is driven.

    Attributes:
        file: its model, or domain and task of dm_control.
        drive: amplitude of each control, or of each goal where a loop is closed around motors.
        gains: proportional and derivative gain of that loop, None for open loop.
        fastest: highest frequency of the excitation in [Hz].
        middle: centre of the goals.
        sampling: seconds between the rows of its logs, where nothing else is asked for.
    """

    file: str
    drive: tuple[float, ...]
    gains: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    fastest: float = 1.5
    middle: tuple[float, ...] = ()
    sampling: float = 0.002


_SIX = (0.5, 0.4, 0.5, 0.7, 0.6, 0.8)
_POSE = (0.0, 0.4, 0.6, 0.0, 0.5, 0.0)
RIGS = {
    "two_link_arm": Rig("two_link_arm.xml", (1.5, 0.4)),
    "cart_pole": Rig("cart_pole.xml", (0.8,)),
    "rotary_pendulum": Rig("rotary_pendulum.xml", (0.25,)),
    "six_motors": Rig(
        "six_joint_arm_motors.xml",
        _SIX,
        ((120.0, 400.0, 200.0, 60.0, 40.0, 12.0), (7.0, 24.0, 12.0, 3.6, 2.4, 0.7)),
        1.0,
        _POSE,
    ),
    "six_servos": Rig("six_joint_arm_servos.xml", _SIX, None, 1.0, _POSE),
    "cheetah": Rig("cheetah run", (1.0,) * 6, None, 2.5, sampling=0.01),
    "hopper": Rig("hopper stand", (1.0,) * 4, None, 2.5, sampling=0.005),
}
CONTACT = ("cheetah", "hopper")


@dataclass(frozen=True)
class Planted:
    """An effect that a plant has: id, site, magnitudes, size in sigma, value as it is reported."""

    effect: str
    kind: str
    site: str
    x: tuple[float, ...]
    size: float = 0.0
    value: float = 0.0


@dataclass(frozen=True)
class Case:
    """A drawn case.

    Attributes:
        rig: name of the machine.
        truth: what the plant has beyond the model.
        train: recordings to diagnose.
        holdout: a recording set aside.
        sigma: noise of the positions.
    """

    rig: str
    truth: tuple[Planted, ...]
    train: tuple[Recording, ...]
    holdout: tuple[Recording, ...]
    sigma: float
    notes: dict[str, object] = field(default_factory=dict)


@dataclass(frozen=True)
class Log:
    """How a recording is written: seconds between rows, and the share that they vary by."""

    sampling: float = 0.002
    jitter: float = 0.0


LOGS = {
    "50 Hz": Log(0.02),
    "100 Hz": Log(0.01),
    "200 Hz, uneven": Log(0.005, 0.3),
    "300 Hz": Log(1 / 300),
    "1000 Hz": Log(0.001),
}


def load(rig: str) -> Model:
    if rig in CONTACT:
        return Model.from_dm_control(*RIGS[rig].file.split())
    return Model.from_file(MODELS / RIGS[rig].file)


def excitation(rng: np.random.Generator, rig: Rig, time: np.ndarray) -> np.ndarray:
    """Return a sum of six sines for each input, `T x nu`."""
    out = np.zeros((len(time), len(rig.drive)))
    for a, amplitude in enumerate(rig.drive):
        for _ in range(6):
            frequency, phase = rng.uniform(0.1, rig.fastest), rng.uniform(0, 2 * np.pi)
            out[:, a] += rng.normal() * np.cos(2 * np.pi * frequency * time + phase)
        out[:, a] *= amplitude / 3
    return out


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
    applied = None
    if rig.gains is None:
        commanded = goal
        applied = _filtered(model, time, goal, filters, fine, ends[-1])
    else:
        kp, kd = (np.array(g) for g in rig.gains)
        gear = compiled.actuator_gear[: len(model.actuators), 0]
        past = _Causal(model, filters, time, fine)
        zero = np.array([offsets.get(f"qpos.{n}", 0.0) for n in model.joints])
    for k, (begin, end) in enumerate(zip(tick, ends, strict=True)):
        if applied is None:
            shown, speed = encoders.read(data)
            seen = shown + zero + sigma * rng.normal(size=len(shown))
            u = (kp * (goal[k] - seen) - kd * speed) / gear
            commanded[k] = u
        for at in range(begin, end):
            position[at] = encoders.read(data)[0]
            now = applied[at] if applied is not None else past(commanded, k, at)
            data.ctrl[: len(now)] = now
            data.qfrc_applied[:] = 0
            view = _View(model, encoders, data, at * fine, fine)
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


STRANGE = ("magnet", "worn_spot", "warming", "cable")


def strange_force(kind: str, machine: Machine, joint: str, size: float, at: float) -> Force:
    """Return physics outside the catalogue.

    Args:
        kind: a magnet near one angle, a spot of more friction, friction that fades as it warms
            up, a cable that pulls one joint when another moves.
        machine: gives the scales.
        joint: where.
        size: in units of the joint's typical force.
        at: where in the joint's range, 0 to 1.
    """
    j = machine.joints[joint]
    centre, width, force = j.middle + (at - 0.5) * 0.5 * j.span, 0.08 * j.span, size * j.force
    other = next((n for n in machine.joints if n != joint), joint)
    far = machine.joints[other]

    def slip(m) -> np.ndarray:
        return np.tanh(m.qvel[joint] / (1e-3 * j.speed))

    def magnet(m) -> np.ndarray:
        z = (m.qpos[joint] - centre) / width
        return -force * 2.0 * z * np.exp(-(z**2))

    def worn_spot(m) -> np.ndarray:
        z = (m.qpos[joint] - centre) / (1.5 * width)
        return -force * slip(m) * np.exp(-(z**2))

    def warming(m) -> np.ndarray:
        return -force * slip(m) * (0.3 + np.exp(-m.time / 6.0))

    def cable(m) -> np.ndarray:
        z = (m.qpos[other] - far.middle) / far.spread
        return force * (z + 0.5 * z**2)

    laws = {"magnet": magnet, "worn_spot": worn_spot, "warming": warming, "cable": cable}
    return Force(joint, laws[kind])


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

    def __call__(self, commanded: np.ndarray, k: int, at: int) -> np.ndarray:
        now = commanded[k].copy()
        first = max(k - self.span, 0)
        for f in self.filters:
            a = self.model.actuators.index(f.actuator)
            later = 2 * self.time[k] - self.time[k - 1] if k else self.time[1]
            time = np.append(self.time[first : k + 1], later)
            values = np.append(commanded[first : k + 1, a], commanded[k, a])
            changed = f.change(Channel(time, values, hold="zero"), self.fine)
            now[a] = changed.at(np.array([at * self.fine + 1e-9]))[0]
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


class Sizes:
    """Measures what effects do to the predictions of a recording, in sigma.

    Args:
        model: the nominal model.
        machine: its scales.
        recording: in which the effects act.
        sigma: noise of the positions.
    """

    def __init__(self, model: Model, machine: Machine, recording: Recording, sigma: float) -> None:
        channels = {n: sigma for n in recording.channels if n.startswith("qpos.")}
        window = _TOUCHING if can_touch(machine.model) else _WINDOW
        horizon = round(window / machine.sampling)
        problem = pose(
            model, machine, [recording], channels, (), horizon=horizon, stride=3, engine=Engine(1)
        )
        self._prepared = prepare(problem)
        self._problem = replace(self._prepared.problem, correction=None)
        self._base = self._problem.residual(nothing(problem), self._prepared.start)

    def of(self, c: Candidate, x: np.ndarray) -> float:
        """Return the rms projected difference that an effect makes."""
        return float(np.sqrt((self._made(c, x) ** 2).sum() / self._problem.dof))

    def alike(self, drawn: Sequence[Candidate], found: Sequence[Planted]) -> bool:
        """Whether two effects make the same difference, up to its size: no recording parts them."""
        made = [self._made(c, np.array(p.x[: c.size])) for c, p in zip(drawn, found, strict=True)]
        one, two = (d.ravel() / np.linalg.norm(d) for d in made)
        return bool(abs(one @ two) > _ALIKE)

    def _made(self, c: Candidate, x: np.ndarray) -> np.ndarray:
        r = self._problem.residual(Hypothesis((c,), (x,)), self._prepared.start)
        return project(self._prepared.linear.Q, r - self._base)

    def seen(self, c: Candidate, x: Sequence[float]) -> np.ndarray:
        """Return the magnitudes without what no prediction shows, as a shift out of the plane."""
        own = np.array(x[: c.size])
        if c.effect.vector < 2:
            return own
        return own * [self.of(c, part) > _NO_SIZE for part in np.diag(own)]

    def scaled(self, c: Candidate, target: float, share: float) -> np.ndarray | None:
        """Return the magnitudes at which an effect makes `target` sigma, None where none do.

        Args:
            c: the effect at its site.
            target: in sigma.
            share: of a joint's damping that acts on the link, where the effect adds a joint; of
                those its gap or compliance alone is sized.
        """
        x = c.point[: c.size].copy()
        sized = np.ones(len(x), bool)
        if c.effect.hidden:
            sized[1:], x[-1] = False, share
        for _ in range(8):
            size = self.of(c, x)
            if not np.isfinite(size) or size <= 0:
                x = np.where(sized, 2 * x, x)
                continue
            factor = np.clip(target / size, 0.2, 5.0)
            x = np.where(sized, x * (np.sqrt(factor) if c.effect.threshold else factor), x)
            if abs(factor - 1) < 0.05:
                break
        inside = (x >= c.low).all() and (x <= c.high).all()
        near = inside and abs(np.log(max(self.of(c, x), 1e-9) / target)) < 0.3
        return x if near else None


def draw(
    rng: np.random.Generator,
    rig: str,
    ids: Sequence[str],
    count: int,
    *,
    low: float = 1.0,
    high: float = 30.0,
    duration: float = 20.0,
    lugre: bool = False,
    log: Log | None = None,
) -> Case:
    """Draw a case with `count` effects of the given ids, at sites where they apply."""
    model, sigma = load(rig), 10 ** rng.uniform(np.log10(3e-4), -3)
    setting = RIGS[rig]
    seed = int(rng.integers(2**31))
    nominal = simulate(model, setting, None, (), seed=seed, duration=10.0, sigma=sigma, log=log)
    machine = survey(model.compile(), [nominal])
    found: list[Planted] = []
    drawn: list[Candidate] = []
    sizes = Sizes(model, machine, nominal, sigma)
    pool = [c for c in candidates([CATALOGUE[i] for i in ids], machine) if not c.secant]
    ids = list(dict.fromkeys(c.effect.id for c in pool))
    for _ in range(_TRIES if ids else 0):
        if len(found) == count:
            break
        effect = ids[int(rng.integers(len(ids)))]
        options = [c for c in pool if c.effect.id == effect]
        if any(p.effect == effect for p in found):
            continue
        c = options[int(rng.integers(len(options)))]
        target = float(np.exp(rng.uniform(np.log(low), np.log(high))))
        share = float(rng.uniform()) if c.effect.hidden else 0.0
        x = sizes.scaled(c, target, share)
        if x is not None:
            value = c.effect.reported(c.full(x), machine, c.site)
            full = tuple(c.full(x))
            found.append(Planted(effect, c.site.kind, c.site.name, full, target, value))
            drawn.append(c)
    if len(found) < count:
        return Case(rig, tuple(found), (), (), sigma)
    train, holdout = (
        simulate(
            model,
            setting,
            machine,
            found,
            seed=seed + k,
            duration=d,
            sigma=sigma,
            lugre=lugre,
            log=log,
        )
        for k, d in ((1, duration), (2, 8.0))
    )
    if count and _runs_away(train, nominal):  # what is free drifts without any force as well
        return Case(rig, (), (), (), sigma)
    acting = Sizes(model, machine, train, sigma)
    if count == 2 and acting.alike(drawn, found):
        return Case(rig, (), (), (), sigma)
    shown = [
        replace(
            p,
            size=acting.of(c, np.array(p.x[: c.size])),
            value=c.effect.reported(c.full(acting.seen(c, p.x)), machine, c.site),
        )
        for p, c in zip(found, drawn, strict=True)
    ]
    return Case(rig, tuple(shown), (train,), (holdout,), sigma)


def draw_strange(rng: np.random.Generator, rig: str, kind: str) -> Case:
    """Draw a case with physics that is not in the catalogue."""
    model, setting, sigma = load(rig), RIGS[rig], 10 ** rng.uniform(np.log10(3e-4), -3)
    seed = int(rng.integers(2**31))
    nominal = simulate(model, setting, None, (), seed=seed, duration=10.0, sigma=sigma)
    machine = survey(model.compile(), [nominal])
    joint = list(machine.joints)[int(rng.integers(len(machine.joints)))]
    size, at = float(np.exp(rng.uniform(np.log(0.05), np.log(0.3)))), float(rng.uniform(0.3, 0.7))
    plain = simulate(model, setting, None, (), seed=seed + 1, duration=20.0, sigma=sigma)
    for _ in range(_TRIES):
        law = strange_force(kind, machine, joint, size, at)
        train, holdout = (
            simulate(
                model, setting, machine, (), seed=seed + k, duration=20.0, sigma=sigma,
                strange=[law],
            )
            for k in (1, 2)
        )  # fmt: skip
        if not (_runs_away(train, plain) or _runs_away(holdout, plain)):
            break
        size = 0.6 * size
    else:  # it is the commands that do
        return Case(rig, (), (), (), sigma)
    return Case(rig, (), (train,), (holdout,), sigma, {"kind": kind, "site": joint, "size": size})


def _runs_away(recording: Recording, nominal: Recording) -> bool:
    """Whether a force drives the machine far out of where it moves without it."""
    spans = [
        [float(np.ptp(c.values)) for c in r.of_kind("qpos").values()] for r in (recording, nominal)
    ]
    return any(with_it > 4 * without for with_it, without in zip(*spans, strict=True))


def draw_group(rng: np.random.Generator, rig: str, effect: str) -> Case:
    """Draw a case in which an effect is missing at every joint."""
    model, setting, sigma = load(rig), RIGS[rig], 5e-4
    seed = int(rng.integers(2**31))
    nominal = simulate(model, setting, None, (), seed=seed, duration=10.0, sigma=sigma)
    machine = survey(model.compile(), [nominal])
    chosen = [c for c in candidates([CATALOGUE[effect]], machine) if not c.secant]
    drawn = [(c, tuple(2 * rng.uniform(0.7, 1.5) * c.probe)) for c in chosen]
    truth = tuple(Planted(effect, c.site.kind, c.site.name, x, 0.0, x[0]) for c, x in drawn)
    train, holdout = (
        simulate(model, setting, machine, truth, seed=seed + k, duration=d, sigma=sigma)
        for k, d in ((1, 20.0), (2, 8.0))
    )
    return Case(rig, truth, (train,), (holdout,), sigma)
