"""A two-link arm with known physics missing, for the tests of the diagnosis."""

from collections.abc import Callable, Sequence
from pathlib import Path

import mujoco
import numpy as np

from bo_sysid.diagnosis.windows.candidate import Candidate, candidates
from bo_sysid.diagnosis.windows.cutting import cut_problem
from bo_sysid.diagnosis.windows.problem import Problem
from bo_sysid.effects import CATALOGUE, Machine, Site, survey
from bo_sysid.mjcf import Model
from bo_sysid.recording import Recording
from bo_sysid.simulation import Engine

ARM = Path(__file__).parents[1] / "studies" / "diagnosis" / "two_link_arm.xml"
SIGMA = 5e-4
NAMES = ("dry_friction", "viscous_damping", "armature", "joint_spring", "payload", "actuator_gain")


def arm() -> Model:
    return Model.from_file(ARM)


def record(
    missing: Sequence[tuple[str, str, str, Sequence[float]]] = (),
    *,
    seed: int = 0,
    duration: float = 6.0,
    sampling: float = 0.002,
    sigma: float = SIGMA,
    finer: int = 4,
    force: tuple[str, Callable[[np.ndarray], np.ndarray]] | None = None,
) -> Recording:
    """Return noisy joint positions of an arm with effects in it, stepped finer than the model.

    Args:
        missing: effects as (id, kind of site, site, magnitudes).
        force: a joint and a force on it as a function of its position, of no known kind.
    """
    rng, model = np.random.default_rng(seed), arm()
    machine = survey(model.compile(), [_moving()])
    edits = [
        lambda spec, e=e: CATALOGUE[e[0]].parts(spec, Site(e[1], e[2]), np.array(e[3]), machine)
        for e in missing
    ]
    compiled = model.compile(edits, timestep=sampling / finer)
    data, time = mujoco.MjData(compiled), np.arange(0, duration, sampling)
    shown = [compiled.joint(n).qposadr[0] for n in model.joints]  # beside joints of gears
    ctrl = sum(
        rng.normal(size=2) * np.sin(2 * np.pi * f * time[:, None] + rng.uniform(0, 6, 2))
        for f in rng.uniform(0.2, 1.5, 6)
    ) * np.array([0.5, 0.13])
    qpos = np.empty((len(time), 2))
    for k, u in enumerate(ctrl):
        qpos[k] = data.qpos[shown]
        data.ctrl[:] = u
        for _ in range(finer):
            if force is not None:
                j = model.joints.index(force[0])
                data.qfrc_applied[j] = force[1](data.qpos[j : j + 1])[0]
            mujoco.mj_step(compiled, data)
    qpos += sigma * rng.normal(size=qpos.shape)
    return Recording.from_arrays(
        time,
        name=f"arm {seed}",
        qpos={"shoulder": qpos[:, 0], "elbow": qpos[:, 1]},
        ctrl={"shoulder": ctrl[:, 0], "elbow": ctrl[:, 1]},
    )


def _moving() -> Recording:
    """Any motion: the scales that effects ask for do not decide what a plant is."""
    t = np.arange(0, 2, 0.01)
    moved = {"shoulder": np.sin(4 * t), "elbow": np.cos(3 * t)}
    return Recording.from_arrays(t, qpos=moved, ctrl=moved)


def posed(recording: Recording, horizon: int = 100) -> tuple[Problem, Machine]:
    model = arm()
    machine = survey(model.compile(), [recording])
    sigma = {"qpos.shoulder": SIGMA, "qpos.elbow": SIGMA}
    problem = cut_problem(model, machine, [recording], sigma, (), horizon=horizon, engine=Engine(1))
    return problem, machine


def candidate(machine: Machine, effect: str, site: str, k: int = 0) -> Candidate:
    made = candidates([CATALOGUE[effect]], machine)
    return [c for c in made if c.site.name == site and not c.secant][k]
