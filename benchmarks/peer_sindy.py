"""Smoothing, inverse dynamics and sparse regression (PySINDy) on a concealed case.

Positions are smoothed and differentiated (Savitzky-Golay); the force that the nominal model lacks
follows from its inverse dynamics; sequentially thresholded least squares (`pysindy.STLSQ`) explains
it, joint by joint, with the terms that the catalogue has names for. Window and threshold are tuned
on development cases.
"""

import itertools
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float
from pysindy.optimizers import STLSQ
from scipy.signal import savgol_filter

from bo_sysid.diagnosis.windows.candidate import Candidate
from bo_sysid.diagnosis.windows.evidence import Evidence
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.effects import CATALOGUE, Site

WINDOWS = (0.03, 0.06, 0.12, 0.2)  # [s]
THRESHOLDS = (0.03, 0.1, 0.3, 0.6)  # of the spread of the missing force
_RIDGE = 1e-3
_EDGE = 30  # samples left out at both ends
_SLOW = 0.02  # of the typical speed, over which the sign of the velocity turns
_ORDER = 3
TERMS = (
    "dry_friction", "viscous_damping", "quadratic_damping", "constant_force", "joint_spring",
    "armature", "actuator_gain", "load_dependent_friction",
)  # fmt: skip


@dataclass(frozen=True)
class Settings:
    """What is tuned.

    Attributes:
        window: of the smoothing, in [s].
        threshold: below which a term is dropped, of the spread of the missing force.
    """

    window: float = 0.06
    threshold: float = 0.1


def grid() -> tuple[Settings, ...]:
    """Return the settings that are tried."""
    return tuple(Settings(w, t) for w, t in itertools.product(WINDOWS, THRESHOLDS))


def fit(evidence: Evidence, settings: Settings) -> tuple[Hypothesis, float]:
    """Return the model with the terms that survive, and the seconds that it took."""
    began = time.perf_counter()
    parts = [_missing(evidence, i, settings.window) for i in range(len(evidence.recordings))]
    members: list[Candidate] = []
    values: list[np.ndarray] = []
    for joint in evidence.machine.joints:
        terms = {n: np.concatenate([p[joint][0][n] for p in parts]) for n in parts[0][joint][0]}
        force = np.concatenate([p[joint][1] for p in parts])
        for c, x in _sparse(evidence, joint, terms, force, settings.threshold):
            members.append(c)
            values.append(x)
    return Hypothesis(tuple(members), tuple(values)), time.perf_counter() - began


def _missing(
    evidence: Evidence, number: int, window: float
) -> dict[str, tuple[dict[str, np.ndarray], Float[np.ndarray, " n"]]]:
    """Return for each joint the terms and the force that the nominal model lacks."""
    machine, recording = evidence.machine, evidence.recordings[number]
    model = machine.model
    data = mujoco.MjData(model)
    q, v, a, t = _smoothed(evidence, number, window)
    lacking, drive = np.zeros_like(v), np.zeros_like(v)
    controls = np.zeros((len(t), model.nu))
    for k, name in enumerate(evidence.model.ctrl_channels):
        channel = recording.channels.get(name)
        if channel is not None:
            at = np.searchsorted(channel.time, t, side="right") - 1
            controls[:, k] = channel.values[np.clip(at, 0, len(channel.values) - 1)]
    for k in range(len(t)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[k], v[k], a[k]
        data.ctrl[:] = controls[k]
        mujoco.mj_inverse(model, data)
        needed = data.qfrc_inverse.copy()
        mujoco.mj_fwdActuation(model, data)
        drive[k] = data.qfrc_actuator
        lacking[k] = needed - drive[k]
    kept = slice(_EDGE, -_EDGE)
    out = {}
    for name, joint in machine.joints.items():
        d = joint.dof
        speed, torque = v[kept, d], drive[kept, d]
        sign = np.tanh(speed / max(_SLOW * joint.speed, 1e-9))
        terms = {
            "dry_friction": -sign,
            "viscous_damping": -speed,
            "quadratic_damping": -speed * np.abs(speed),
            "constant_force": np.ones_like(speed),
            "joint_spring": -q[kept, int(model.jnt_qposadr[model.dof_jntid[d]])],
            "armature": -a[kept, d],
        }
        if joint.actuators:
            terms["actuator_gain"] = torque
            terms["load_dependent_friction"] = -sign * np.abs(torque)
        out[name] = terms, lacking[kept, d]
    return out


def _smoothed(
    evidence: Evidence, number: int, window: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return positions, velocities, accelerations and their times."""
    model, recording = evidence.machine.model, evidence.recordings[number]
    times = next(iter(recording.of_kind("qpos").values())).time
    dt = float(np.median(np.diff(times)))
    width = max(round(window / dt) | 1, _ORDER + 2)
    q = np.tile(model.qpos0, (len(times), 1))
    v, a = np.zeros((len(times), model.nv)), np.zeros((len(times), model.nv))
    for joint, scale in evidence.machine.joints.items():
        channel = recording.channels.get(f"qpos.{joint}")
        if channel is None:
            continue
        x = np.interp(times, channel.time, channel.values)
        q[:, int(model.joint(joint).qposadr[0])] = savgol_filter(x, width, _ORDER)
        v[:, scale.dof] = savgol_filter(x, width, _ORDER, deriv=1, delta=dt)
        a[:, scale.dof] = savgol_filter(x, width, _ORDER, deriv=2, delta=dt)
    return q, v, a, times


def _sparse(
    evidence: Evidence,
    joint: str,
    terms: dict[str, np.ndarray],
    force: np.ndarray,
    threshold: float,
) -> list[tuple[Candidate, np.ndarray]]:
    """Return the terms that survive as candidates of the catalogue with their magnitudes."""
    names = list(terms)
    X = np.stack([terms[n] for n in names], axis=1)
    scale, spread = X.std(axis=0), force.std()
    scale[scale == 0] = 1.0  # the constant
    if spread == 0:
        return []
    optimizer = STLSQ(threshold=threshold, alpha=_RIDGE)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # nothing survives: that is an answer
        optimizer.fit(X / scale, force / spread)
    found = dict(zip(names, np.ravel(optimizer.coef_) * spread / scale, strict=True))
    rest = found.pop("constant_force", 0.0)
    out = []
    for name, value in found.items():
        extra = rest if name == "joint_spring" else None
        out += _named(evidence, joint, name, value, extra)
    if not found.get("joint_spring"):
        out += _named(evidence, joint, "constant_force", rest, None)
    return out


def _named(
    evidence: Evidence, joint: str, name: str, value: float, extra: float | None
) -> Sequence[tuple[Candidate, np.ndarray]]:
    """Return a term as a candidate, its magnitude within the catalogue's bounds."""
    machine, effect = evidence.machine, CATALOGUE[name]
    site = Site(effect.kind, joint)
    if effect.kind == "actuator":
        site = Site(effect.kind, machine.joints[joint].actuators[0])
    extent = effect.extent(site, machine)
    if not value or extent is None:
        return []
    candidate = Candidate(effect, site, extent, np.array(extent.probe, float))
    x = np.array([value] if candidate.size == 1 else [value, extra or 0.0])
    x = np.clip(x, candidate.low, candidate.high)
    return [(candidate, x)] if np.any(x) else []
