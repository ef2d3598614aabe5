"""Small machines with recordings, and what an effect makes of their predictions."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import mujoco
import numpy as np

from bo_sysid.effects import (
    Effect,
    Filter,
    Force,
    Hidden,
    Machine,
    Part,
    Reading,
    Site,
    applicable,
    survey,
)
from bo_sysid.mjcf import Model
from bo_sysid.recording import Recording
from bo_sysid.recording.alignment import control_steps
from bo_sysid.simulation.lockstep import LawInputs

STEPS = 40

LINKS = """
<worldbody><body name="upper"><joint name="shoulder" axis="0 1 0" damping=".05"/>
 <geom name="upper" type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass="1"/>
 <body name="fore" pos="0 0 -.3"><joint name="elbow" axis="0 1 0" damping=".05"/>
  <geom name="fore" type="capsule" fromto="0 0 0 .02 0 -.25" size=".018" mass=".6"/>
  <site name="hand" pos="0 0 -.25"/></body></body></worldbody>"""
SENSORS = """<sensor><accelerometer name="hand" site="hand"/></sensor>"""
OPTION = """<compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/>
<default><geom contype="0" conaffinity="0"/></default>"""
XML = {
    "motors": f"""<mujoco>{OPTION}{LINKS}<actuator>
 <motor name="shoulder" joint="shoulder"/><motor name="elbow" joint="elbow" gear="2"/></actuator>
 {SENSORS}</mujoco>""",
    "servos": f"""<mujoco>{OPTION}{LINKS}<actuator>
 <position name="shoulder" joint="shoulder" kp="40" kv="4" forcerange="-3 5"/>
 <position name="elbow" joint="elbow" kp="20" dampratio=".8"/></actuator></mujoco>""",
    "cart-pole": f"""<mujoco>{OPTION}<option density="1000" viscosity=".05"/><worldbody>
 <body name="cart"><joint name="slider" type="slide" axis="1 0 0"/>
  <geom type="box" size=".1 .06 .05" mass="1"/>
  <body name="pole"><joint name="hinge" axis="0 1 0"/>
   <geom type="capsule" fromto="0 0 0 0 0 -.5" size=".012" mass=".2"/></body></body></worldbody>
 <actuator><motor name="belt" joint="slider" gear="10"/></actuator></mujoco>""",
    "box": """<mujoco><option timestep="0.002"/><worldbody>
 <geom name="floor" type="plane" size="1 1 .1" friction=".6" condim="1"/>
 <body name="box" pos="0 0 .05"><freejoint name="box"/>
  <geom name="block" type="box" size=".08 .06 .05" mass=".5" friction=".4" solref=".03 1"/>
 </body></worldbody></mujoco>""",
}


@dataclass(frozen=True)
class Case:
    """A machine, where it starts, and what drives it."""

    name: str
    model: Model
    machine: Machine
    recording: Recording
    qpos: np.ndarray
    qvel: np.ndarray

    def sites(self, effect: Effect) -> tuple[Site, ...]:
        return applicable(effect, self.machine)

    def some(self, effect: Effect, most: int = 3) -> list[Site]:
        """Return a few sites from first to last."""
        sites = self.sites(effect)
        if not sites:
            return []
        return [sites[k] for k in sorted({round(k) for k in np.linspace(0, len(sites) - 1, most)})]

    def points(self, effect: Effect, site: Site) -> list[np.ndarray]:
        extent = effect.extent(site, self.machine)
        assert extent is not None
        return [np.array(p) for p in (extent.grid or (extent.probe,))]


@cache
def case(name: str) -> Case:
    model = (
        Model.from_dm_control("cheetah", "run") if name == "cheetah" else Model.from_xml(XML[name])
    )
    compiled = model.compile()
    data = mujoco.MjData(compiled)
    rng = np.random.default_rng(0)
    if name == "box":
        data.qvel[:3] = (1.0, 0.3, 0.0)
    elif name == "cheetah":
        data.qpos[1] = -0.1
        data.qpos[3:] += 0.05 * rng.normal(size=compiled.nq - 3)
    else:
        data.qpos[:] = 0.3
        data.qvel[:] = 0.5
    qpos, qvel = data.qpos.copy(), data.qvel.copy()
    t = np.arange(STEPS + 1) * compiled.opt.timestep
    ctrl = {
        model.actuators[k]: 0.8 * np.sin((9 + 4 * k) * t + k) + 0.2 * np.sign(np.sin(25 * t))
        for k in range(compiled.nu)
    }
    u = np.array(list(ctrl.values())).reshape(compiled.nu, len(t))
    rows: dict[str, list[np.ndarray]] = {"qpos": [], "qvel": [], "sensor": []}
    for k in range(STEPS + 1):
        if compiled.nu:
            data.ctrl[:] = u[:, k]
        rows["qpos"].append(data.qpos.copy())
        rows["qvel"].append(data.qvel.copy())
        mujoco.mj_step(compiled, data)
        rows["sensor"].append(data.sensordata.copy())
    names = {
        "qpos": model.qpos_channels,
        "qvel": model.qvel_channels,
        "sensor": model.sensor_channels,
    }
    channels = {
        kind: {c.split(".", 1)[1]: np.array(rows[kind])[:, i] for i, c in enumerate(names[kind])}
        for kind in rows
        if names[kind]
    }
    aux = {"voltage": 24.0 - 4.0 * t / t[-1]} if compiled.nu else {}
    units = {"aux.voltage": "V"}
    recording = Recording.from_arrays(
        t, units=units, **channels, **({"ctrl": ctrl, "aux": aux} if ctrl else {})
    )
    return Case(name, model, survey(compiled, [recording]), recording, qpos, qvel)


def cases() -> list[str]:
    return [*XML, "cheetah"]


Channels = Mapping[str, np.ndarray]


def predict(
    c: Case,
    effect: Effect | None = None,
    site: Site | None = None,
    x: np.ndarray | None = None,
    *,
    file: Path | None = None,
    written: bool = False,
) -> Channels:
    """Return what the channels would show, simulated step by step in plain MuJoCo.

    Args:
        file: where to export the edited model, which is then read by plain MuJoCo.
        written: express the effect as in a model file.
    """
    if effect is None:
        return simulate(c, c.model.compile(), ())
    return simulate(c, *edited(c, effect, site, x, file=file, written=written))


def edited(
    c: Case,
    effect: Effect,
    site: Site,
    x: np.ndarray,
    *,
    file: Path | None = None,
    written: bool = False,
) -> tuple[mujoco.MjModel, tuple[Part, ...]]:
    """Return the edited model and the parts of the effect."""
    made: list[tuple[Part, ...]] = []  # a model with settotalmass may be edited twice
    make = effect.write if written else effect.parts
    edits = [lambda spec: made.append(make(spec, site, x, c.machine))]
    if file is None:
        model = c.model.compile(edits)
    else:
        c.model.export(file, edits)
        model = mujoco.MjModel.from_xml_path(str(file))
    return model, made[-1]


def simulate(c: Case, model: mujoco.MjModel, parts: Sequence[Part]) -> Channels:
    nominal, data = c.machine.model, mujoco.MjData(model)
    for j in range(nominal.njnt):
        own, new = nominal.joint(j), model.joint(nominal.joint(j).name)
        size = len(own.qpos0)
        data.qpos[new.qposadr[0] : new.qposadr[0] + size] = c.qpos[own.qposadr[0] :][:size]
        nv = max(size - 1, 1) if size > 1 else 1
        data.qvel[new.dofadr[0] : new.dofadr[0] + nv] = c.qvel[own.dofadr[0] :][:nv]
    dt = model.opt.timestep
    steps = round(STEPS * nominal.opt.timestep / dt)
    ctrl = _controls(c, model, parts, steps)
    laws = [(p, {}) for p in parts if isinstance(p, Force)]
    shown: dict[str, list[float]] = {n: [] for n in c.machine.channels}
    order = {n: i for i, n in enumerate(c.model.sensor_channels)}
    for k in range(steps + 1):
        data.ctrl[: nominal.nu] = ctrl[min(k, steps - 1)]
        data.qfrc_applied[:] = 0
        inputs = _inputs(c, model, data, ctrl[min(k, steps - 1)], k * dt)
        for part, memory in laws:
            value = part.law(LawInputs(*inputs, dt, memory))
            data.qfrc_applied[model.joint(part.joint).dofadr[0]] += value[0]
        row = {n: _shown(c, model, data, n) for n in shown if not n.startswith("sensor.")}
        mujoco.mj_step(model, data)
        row |= {n: float(data.sensordata[i]) for n, i in order.items()}
        read = {n: _read(n, row, model, data, parts) for n in shown}
        for name, value in read.items():
            shown[name].append(value)
    assert not data.warning.number.any()
    stride = round(nominal.opt.timestep / dt)
    return {n: np.array(v[::stride]) for n, v in shown.items()}


def _controls(c: Case, model: mujoco.MjModel, parts: Sequence[Part], steps: int) -> np.ndarray:
    ctrl = np.zeros((steps, c.machine.model.nu))
    for i, name in enumerate(c.model.ctrl_channels):
        channel = c.recording.channels[name]
        for p in parts:
            if isinstance(p, Filter) and f"ctrl.{p.actuator}" == name:
                channel = p.change(channel, model.opt.timestep)
        ctrl[:, i] = control_steps(channel, np.zeros(1), steps, model.opt.timestep)[0]
    return ctrl


def _inputs(
    c: Case, model: mujoco.MjModel, data: mujoco.MjData, ctrl: np.ndarray, t: float
) -> tuple:
    every = [model.joint(j) for j in range(model.njnt)]
    joints = {j.name for j in every if len(j.qpos0) == 1}  # as a law is shown them
    names = [n.removeprefix("ctrl.") for n in c.model.ctrl_channels]
    return (
        np.array([t]),
        {n: data.qpos[[model.joint(n).qposadr[0]]] for n in joints},
        {n: data.qvel[[model.joint(n).dofadr[0]]] for n in joints},
        {n: ctrl[[i]] for i, n in enumerate(names)},
        {n: c.recording.channels[n].at(np.array([t])) for n in c.machine.inputs},
    )


def _shown(c: Case, model: mujoco.MjModel, data: mujoco.MjData, channel: str) -> float:
    kind, _, name = channel.partition(".")
    joint, _, index = name.rpartition(".")
    if joint not in c.model.joints:
        joint, index = name, "0"
    j = model.joint(joint)
    if kind == "qpos":
        return float(data.qpos[j.qposadr[0] + int(index)])
    return float(data.qvel[j.dofadr[0] + int(index)])


def _read(
    name: str, row, model: mujoco.MjModel, data: mujoco.MjData, parts: Sequence[Part]
) -> float:
    """Return what a channel reads; a delay is first order: value - delay · rate."""
    value = row[name]
    kind, joint = name.split(".", 1)
    for p in parts:
        if isinstance(p, Hidden) and p.of == joint and kind == "qpos":
            value += p.shown * data.qpos[model.joint(p.joint).qposadr[0]]
        if isinstance(p, Reading) and p.channel == name:
            value = row[p.source] if p.source else value
            rate = row.get(name.replace("qpos", "qvel"), 0.0)
            value = (1 + p.scale) * (value - p.delay * rate) + p.offset
    return float(value)
