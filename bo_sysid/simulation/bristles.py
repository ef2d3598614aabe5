"""Bristles of friction where a simulation begins: bent by what their joint bears."""

from dataclasses import replace

import mujoco
import numpy as np
from jaxtyping import Float, Int

from bo_sysid.simulation.state import State

_STIFFNESS = 5  # place in `dynprm` of a motor with LuGre friction
_STEADY = slice(3, 6)  # place in `biasprm` of sliding level, level at standstill and their speed
_LEAST = 1e-30  # [J] that bristles store


def bristle_motors(model: mujoco.MjModel) -> Int[np.ndarray, " b"]:
    """Return the motors at joints whose one activation is how far bristles are bent.

    Those that effects of friction added to a model, and any like them that it came with.
    """
    motors = model.actuator_dyntype == int(mujoco.mjtDyn.mjDYN_DCMOTOR)
    at_joint = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)
    bristled = (model.actuator_dynprm[:, _STIFFNESS] > 0) & (model.actuator_actnum == 1)
    return np.flatnonzero(motors & at_joint & bristled)


def with_loaded_bristles(
    model: mujoco.MjModel, start: State, ctrl: Float[np.ndarray, "W nu"]
) -> State:
    """Return starts whose bristles are bent as `loaded` says, where a model has bristles."""
    motors = bristle_motors(model)
    if not motors.size:
        return start
    act = start.act.copy()
    act[:, model.actuator_actadr[motors]] = loaded(model, motors, start, ctrl)
    return replace(start, act=act)


def loaded(
    model: mujoco.MjModel,
    motors: Int[np.ndarray, " b"],
    start: State,
    ctrl: Float[np.ndarray, "W nu"],
) -> Float[np.ndarray, "W b"]:
    """Return how far bristles are bent where nothing of the past is known, in [rad] or [m].

    At rest they carry what would set their joint in motion, up to the level of friction F; straight
    ones would let it go, since they overshoot to twice the load. In motion they are bent by F/σ₀
    against it. Between lies the speed at which they store what the joint moves with,
    m·v²/2 = F²/σ₀.

    Args:
        model: with bristles.
        motors: that hold them.
        start: where else simulations begin.
        ctrl: their first controls.
    """
    stiffness = model.actuator_dynprm[motors, _STIFFNESS]
    dof = model.jnt_dofadr[model.actuator_trnid[motors, 0]]
    v = start.qvel[:, dof]
    low, high, speed = model.actuator_biasprm[motors, _STEADY].T
    most = (low + (high - low) * np.exp(-((v / speed) ** 2))) / stiffness
    load, mass = _loads(model, motors, dof, start, ctrl)
    slides = -np.expm1(-0.5 * mass * v**2 / np.maximum(stiffness * most**2, _LEAST))
    held = np.clip(load / stiffness, -most, most)
    return np.asarray(held + slides * (np.sign(v) * most - held))


def _loads(
    model: mujoco.MjModel,
    motors: Int[np.ndarray, " b"],
    dof: Int[np.ndarray, " b"],
    start: State,
    ctrl: Float[np.ndarray, "W nu"],
) -> tuple[Float[np.ndarray, "W b"], Float[np.ndarray, "W b"]]:
    """Return the forces that friction must bear to hold some joints, and the inertia each feels.

    Those are (M⁻¹)ₛₛ⁻¹ q̈ₛ, where q̈ is without friction of theirs: against them the joints s do not
    accelerate.
    """
    data = mujoco.MjData(model)
    load, mass = np.zeros((len(start), len(dof))), np.zeros((len(start), len(dof)))
    units, columns = np.eye(model.nv)[dof], np.zeros((len(dof), model.nv))
    deflections = model.actuator_actadr[motors]
    for w in range(len(start)):
        start.begin(data, w, ctrl[w])
        data.qvel[dof], data.act[deflections] = 0.0, 0.0
        mujoco.mj_forward(model, data)
        mujoco.mj_solveM(model, data, columns, units)
        load[w] = np.linalg.solve(columns[:, dof], data.qacc[dof])
        mass[w] = 1.0 / np.diagonal(columns[:, dof])
    return load, mass
