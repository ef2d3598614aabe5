"""How fast Δ is against the bare engine, in one run.

Raw is `mj_step` along the recorded trajectories: controls are set, nothing else, and nothing is
read. Δ sets the model's parameters, loads every recorded start, steps, and takes the norms. Both
are measured in turn, A B A B, and the median of the ratios is reported.
"""

import time

import mujoco
import numpy as np
from common import Cases, benchmark

from bo_sysid.deviation import Deviation, Whitening
from bo_sysid.mjcf import Model
from bo_sysid.parameters import Parameter
from bo_sysid.plants.excitation import smooth_random
from bo_sysid.plants.plant import Plant
from bo_sysid.plants.tasks import find_task
from bo_sysid.simulation import Engine, MujocoSimulator, Windows, cut

ROBOTS = {
    "cheetah": ("cheetah", "run", "body[torso].mass"),
    "hopper": ("hopper", "stand", "body[torso].mass"),
    "swimmer": ("swimmer", "swimmer3", "body[head].mass"),
}
TRANSITIONS = 20_000


def windows_of(model: Model, domain: str, task: str, transitions: int) -> Windows:
    """Return one-step windows, one a control step, of trajectories under random controls."""
    made = find_task(domain, task)
    plant = Plant(model, task=made)
    compiled = model.compile()
    steps = 1_000
    recordings = []
    for seed in range(-(-transitions // (steps - 1))):
        controls = smooth_random(
            compiled, steps * plant.control_timestep, plant.control_timestep, seed=seed
        )
        recordings.append(plant.record(controls, sample=plant.control_timestep, warmstart=True))
    return cut(model, recordings, horizon=1).rows(slice(0, transitions))


def raw_speed(model: mujoco.MjModel, windows: Windows) -> float:
    """Return steps per second of the engine alone, on one core, along the same trajectories."""
    data = mujoco.MjData(model)
    first = np.flatnonzero(np.diff(windows.recording, prepend=-1))
    control = np.ascontiguousarray(windows.ctrl[:, 0])
    started = time.perf_counter()
    for start, stop in zip(first, np.append(first[1:], len(windows)), strict=True):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = windows.start.qpos[start], windows.start.qvel[start]
        for u in control[start:stop]:
            data.ctrl[:] = u
            mujoco.mj_step(model, data, nstep=windows.steps)
    return len(windows) * windows.steps / (time.perf_counter() - started)


def delta_speed(deviation: Deviation, points: np.ndarray) -> float:
    """Return simulated steps per second of Δ."""
    started = time.perf_counter()
    deviation(points)
    steps = len(points) * len(deviation.windows) * deviation.windows.steps
    return steps / (time.perf_counter() - started)


def measure(robot: str, repeats: int) -> dict[str, float]:
    """Return the ratio to raw on one thread, and of two threads to one."""
    domain, task, address = ROBOTS[robot]
    model = Model.from_dm_control(domain, task)
    windows = windows_of(model, domain, task, TRANSITIONS)
    parameter = Parameter("mass", (address,), 0.9, 1.1, apply="scale")
    one, two = (
        Deviation(MujocoSimulator(model, (parameter,), Engine(n)), windows, Whitening.of(windows))
        for n in (1, 2)
    )
    compiled = model.compile()
    rows = []
    for k in range(repeats):
        point = np.array([[0.95 + 0.1 * k / repeats]])
        rows.append(
            (
                raw_speed(compiled, windows),
                delta_speed(one, point),
                delta_speed(two, point),
            )
        )
    raw, single, double = np.array(rows).T
    hundred = 100 * TRANSITIONS * windows.steps / np.median(single)
    return {
        "raw_steps_per_second": float(np.median(raw)),
        "fraction": float(np.median(single / raw)),
        "fraction_low": float(np.quantile(single / raw, 0.25)),
        "fraction_high": float(np.quantile(single / raw, 0.75)),
        "threads_2": float(np.median(double / single)),
        "seconds_100_candidates": float(hundred),
    }


def run(quick: bool, cases: Cases) -> dict[str, object]:
    """Measure every robot."""
    found = {r: cases.get(r, lambda r=r: measure(r, 3 if quick else 15)) for r in ROBOTS}
    return {
        **{robot: f["fraction"] for robot, f in found.items()},
        "threads_2": min(f["threads_2"] for f in found.values()),
        "details": found,
    }


if __name__ == "__main__":
    benchmark("engine", run)
