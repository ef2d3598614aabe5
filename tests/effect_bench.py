"""Machines so simple that what an effect does to them can be computed."""

import mujoco
import numpy as np

from bo_sysid.effects import CATALOGUE, Force, Machine, Site, survey
from bo_sysid.mjcf import Model
from bo_sysid.recording import Recording
from bo_sysid.simulation.lockstep import LawInputs

G = 9.81
SLIDE = """<mujoco><option timestep="0.001" gravity="0 0 0" integrator="implicitfast"/>
<default><geom contype="0" conaffinity="0"/></default><worldbody>
<body name="cart"><joint name="x" type="slide" axis="1 0 0"/>
 <geom type="box" size=".1 .1 .1" mass="2"/></body></worldbody>
<actuator><motor name="drive" joint="x" gear="3"/></actuator></mujoco>"""
PENDULUM = """<mujoco><option timestep="0.001" integrator="RK4"/>
<default><geom contype="0" conaffinity="0"/></default><worldbody>
<body name="rod"><joint name="hinge" axis="0 1 0" damping="{damping}"/>
 <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".01" mass=".5"/>
 <site name="tip" pos="0 0 -.4"/></body></worldbody>{actuator}</mujoco>"""
SERVO = '<actuator><position name="servo" joint="hinge" kp="10" kv="1"/></actuator>'
MOTOR = '<actuator><motor name="motor" joint="hinge"/></actuator>'


class Bench:
    """A model with a recording of the right size, and its edited copies."""

    def __init__(self, xml: str, aux: dict[str, np.ndarray] | None = None) -> None:
        self.model = Model.from_xml(xml)
        compiled = self.model.compile()
        t = np.arange(0, 4, 0.002)
        joints = [compiled.joint(j).name for j in range(compiled.njnt) if compiled.jnt_type[j] >= 2]
        ctrl = {n: np.sin(3 * t) for n in self.model.actuators}
        self.machine: Machine = survey(
            compiled,
            [
                Recording.from_arrays(
                    t,
                    qpos={j: np.sin(2 * t) for j in joints} or {"free": np.sin(2 * t)},
                    ctrl=ctrl or {"none": 0 * t},
                    aux=aux or {},
                    units={f"aux.{n}": "V" for n in aux or {}},
                )
            ],
        )

    def edited(self, id: str, kind: str, site: str, x: list[float], *, written: bool = False):
        parts: list[tuple] = []
        make = CATALOGUE[id].write if written else CATALOGUE[id].parts
        at = Site(kind, site)
        model = self.model.compile(
            [lambda spec: parts.append(make(spec, at, np.array(x, float), self.machine))]
        )
        return model, parts[-1]

    def run(self, model, parts, seconds: float, *, ctrl=0.0, v=0.0, q=None, signals=None):
        """Return time, qpos and qvel of a simulation with the force laws among `parts`."""
        data = mujoco.MjData(model)
        data.qvel[:] = v
        if q is not None:
            data.qpos[:] = q
        laws = [(p, {}) for p in parts if isinstance(p, Force)]
        rows = [(0.0, data.qpos.copy(), data.qvel.copy())]
        while data.time < seconds - 1e-9:
            data.ctrl[:] = ctrl
            data.qfrc_applied[:] = 0
            for p, memory in laws:
                motion = LawInputs(
                    np.array([data.time]),
                    {n: data.qpos[[model.joint(n).qposadr[0]]] for n in self.machine.joints},
                    {n: data.qvel[[model.joint(n).dofadr[0]]] for n in self.machine.joints},
                    {n: data.ctrl[[i]] for i, n in enumerate(self.model.actuators)},
                    {k: np.array([s]) for k, s in (signals or {}).items()},
                    model.opt.timestep,
                    memory,
                )
                data.qfrc_applied[model.joint(p.joint).dofadr[0]] += p.law(motion)[0]
            mujoco.mj_step(model, data)
            rows.append((data.time, data.qpos.copy(), data.qvel.copy()))
        assert not data.warning.number.any()
        t, q, v = zip(*rows, strict=True)
        return np.array(t), np.array(q), np.array(v)

    def effect(self, id: str, kind: str, site: str, x: list[float], seconds: float, **how):
        return self.run(*self.edited(id, kind, site, x), seconds, **how)


def pendulum(actuator: str = "", damping: float | str = 0.0) -> Bench:
    return Bench(PENDULUM.format(actuator=actuator, damping=damping))


def period(t: np.ndarray, q: np.ndarray) -> float:
    """Return the mean period from upward crossings of zero."""
    up = np.flatnonzero((q[:-1] < 0) & (q[1:] >= 0))
    at = t[up] - q[up] * (t[up + 1] - t[up]) / (q[up + 1] - q[up])
    return float(np.diff(at).mean())
