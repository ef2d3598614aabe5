"""Logs of small machines, for the tests of `init`."""

from math import pi
from pathlib import Path

import mujoco
import numpy as np

from bo_sysid.mjcf import Model
from bo_sysid.simulation import Engine, State


def tones(time: np.ndarray, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    parts = [np.sin(2 * pi * f * time + rng.uniform(0, 6)) for f in rng.uniform(0.2, 2.0, 5)]
    return np.sum(parts, axis=0) / 3 * np.minimum(time / 0.5, 1.0)


def moved(path: Path, drive: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return time, positions, speeds and controls of a model under random tones."""
    model = Model.from_file(path).compile()
    time = np.arange(0.0, 12.0, 0.004)
    ctrl = np.stack([drive * tones(time, a + 3) for a in range(model.nu)], axis=1)
    start = State(np.zeros((1, model.nq)), np.zeros((1, model.nv)), np.zeros((1, 0)))
    steps = round(0.004 / model.opt.timestep)
    run = Engine(1).rollout(model, start, np.repeat(ctrl, steps, axis=0)[None])
    noise = 1e-4 * np.random.default_rng(0).standard_normal((len(time), model.nq))
    return time, run.qpos[0, :-1:steps] + noise, run.qvel[0, :-1:steps], ctrl


HAND = """
<mujoco><worldbody><body><joint name="yaw"/><geom size=".1"/><body><joint name="shoulder"/>
  <geom size=".1"/><body><joint name="elbow"/><geom size=".1"/><body>
  <joint name="gripper" type="slide"/><geom size=".1"/></body></body></body></body></worldbody>
  <actuator><position name="ma" joint="yaw"/><position name="mb" joint="shoulder"/>
  <position name="mc" joint="elbow"/><position name="md" joint="gripper"/></actuator></mujoco>
"""


TIMES = 1e6 * np.arange(0.0, 2.0, 0.01)


WAVE = np.sin(1e-6 * TIMES)


WHEEL = """
<mujoco><option timestep="0.004"/><worldbody><body>
  <joint name="wheel" axis="0 1 0" damping="0.02" {limits}/>
  <geom type="capsule" fromto="0 0 0 .2 0 0" size=".02" mass="1"/></body></worldbody>
  <actuator><motor name="wheel" joint="wheel"/></actuator></mujoco>"""


BOOM = """
<mujoco><option timestep="0.004"/><compiler angle="degree"/><worldbody><body name="boom">
  <joint name="boom_joint" axis="0 1 0" range="-30 150" limited="true" damping=".05"/>
  <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass="1"/></body></worldbody>
  <actuator><motor name="boom_drive" joint="boom_joint" gear="50"/></actuator></mujoco>"""


def held_up(path: Path, centre: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return time, angle and control of a boom that a controller moves about an angle."""
    path.write_text(BOOM)
    model = Model.from_file(path).compile()
    data, time = mujoco.MjData(model), np.arange(0.0, 12.0, model.opt.timestep)
    wanted, angles, ctrl = centre + 0.6 * tones(time, 2), [], []
    data.qpos[:] = wanted[0]
    for goal in wanted:
        data.ctrl[:] = (20 * (goal - data.qpos[0]) - data.qvel[0]) / 50
        angles.append(float(data.qpos[0]))
        ctrl.append(float(data.ctrl[0]))
        mujoco.mj_step(model, data)
    noise = 1e-4 * np.random.default_rng(1).standard_normal(len(time))
    return time, np.array(angles) + noise, np.array(ctrl)
