"""The log of a two-link arm, to be spoilt, for the tests of the wiring."""

import functools
from collections.abc import Callable
from math import pi

import numpy as np

from bo_sysid.checks.wiring import Wiring, find_wiring
from bo_sysid.mjcf import Model
from bo_sysid.recording import Channel, Recording
from bo_sysid.simulation import Engine, State

ARM = """
<mujoco>
  <option timestep="0.001" integrator="implicitfast"/>
  <worldbody>
    <body><joint name="shoulder" axis="0 1 0" damping=".05"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass="1"/>
      <body pos="0 0 -.3"><joint name="elbow" axis="0 1 0" damping=".05"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.25" size=".018" mass=".6"/></body></body>
  </worldbody>
  <actuator><motor name="a" joint="shoulder"/><motor name="b" joint="elbow"/></actuator>
</mujoco>
"""


SERVO = """
<mujoco>
  <option timestep="0.001" integrator="implicitfast"/>
  <worldbody>
    <body><joint name="hinge" axis="0 1 0" damping=".02" armature=".002"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".5"/></body>
  </worldbody>
  <actuator><{kind} joint="hinge" name="m"/></actuator>
</mujoco>
"""


def tones(time: np.ndarray, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    parts = [np.sin(2 * pi * f * time + rng.uniform(0, 6)) for f in rng.uniform(0.2, 2.2, 6)]
    return np.sum(parts, axis=0) / 3


@functools.cache
def recorded() -> Recording:
    """Return a log of the arm with 10 % more mass than the model's, sampled every 4 ms."""
    model = Model.from_xml(ARM)
    heavier = model.compile([lambda spec: [setattr(g, "mass", 1.1 * g.mass) for g in spec.geoms]])
    time = np.arange(0.0, 12.0, 0.004)
    ctrl = np.stack([2.0 * tones(time, 1), 0.8 * tones(time, 2)], axis=1)
    start = State(np.zeros((1, 2)), np.zeros((1, 2)), np.zeros((1, 0)))
    run = Engine(1).rollout(heavier, start, np.repeat(ctrl, 4, axis=0)[None])
    noise = 3e-4 * np.random.default_rng(0).standard_normal((len(time), 2))
    qpos, qvel = run.qpos[0, ::4][:-1] + noise, run.qvel[0, ::4][:-1]
    return Recording.from_arrays(
        time,
        qpos={"shoulder": qpos[:, 0], "elbow": qpos[:, 1]},
        qvel={"shoulder": qvel[:, 0], "elbow": qvel[:, 1]},
        ctrl={"a": ctrl[:, 0], "b": ctrl[:, 1]},
    )


def spoilt(change: Callable[[dict[str, np.ndarray]], None], late: float = 0.0) -> Wiring:
    """Return the wiring of the arm's log after `change`, commands stamped `late` too early."""
    log = recorded()
    values = {n: np.array(c.values) for n, c in log.channels.items()}
    change(values)
    channels = {
        n: Channel(c.time - (late if n.startswith("ctrl.") else 0.0), values[n], c.unit, n, c.hold)
        for n, c in log.channels.items()
    }
    return find_wiring(Model.from_xml(ARM).compile(), [Recording("log", channels)])


def speed_servo(friction: float, seed: int, late: float = 0.0) -> Wiring:
    """Return the wiring of a log of a stiff speed servo, its commands stamped `late` too early."""
    servo = SERVO.replace('axis="0 1 0"', 'axis="0 0 1"').replace('mass=".5"', 'mass=".1"')
    servo = servo.format(kind='velocity kv="3.2"')
    rubs = servo.replace("damping", f'frictionloss="{friction}" damping')
    time = np.arange(0.0, 12.0, 0.005)
    goal = 2.0 * tones(time, seed)
    start = State(np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((1, 0)))
    plant = Model.from_xml(rubs).compile()
    run = Engine(1).rollout(plant, start, np.repeat(goal, 5)[None, :, None])
    noise = 5e-4 * np.random.default_rng(1).standard_normal(len(time))
    log = Recording.from_arrays(time, qpos={"hinge": run.qpos[0, ::5, 0][:-1] + noise})
    told = Channel(time - late, goal, "1", "ctrl.m", "zero")
    channels = {**log.channels, "ctrl.m": told}
    return find_wiring(Model.from_xml(servo).compile(), [Recording("log", channels)])


def picked(log: Recording, rows: np.ndarray, factor: float = 1.0) -> Recording:
    """Return some samples of a log, times a factor."""
    channels = {
        n: Channel(c.time[rows], factor * c.values[rows], c.unit, n, c.hold)
        for n, c in log.channels.items()
    }
    return Recording("log", channels)


def without(log: Recording, first: float, last: float) -> Recording:
    """Return a log without its samples between two times in [s]."""
    time = next(iter(log.channels.values())).time
    return picked(log, (time <= first) | (time >= last))
