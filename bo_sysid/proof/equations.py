"""Equations of motion of small machines, on paper: plants that are not the simulator.

Each function reads masses, inertias and lengths from a compiled model, once, and returns the
accelerations as closed-form functions of the motion: Lagrange's equations of two coordinates,

    M(q) a + n(q, v) = τ + G(q),

with M the mass matrix, n the Coriolis and centrifugal terms, τ the forces along the joints and
G the gravity, whose direction is free. Notation: c, s are cosine and sine of an angle; R(φ) turns
about the joint's axis; R'(φ) = dR/dφ. MuJoCo's own dynamics enter only the tests, which compare.
"""

from collections.abc import Callable, Mapping
from math import cos, sin
from types import MappingProxyType
from typing import TypeAlias

import mujoco
import numpy as np

from bo_sysid.errors import ModelError
from bo_sysid.mjcf.joints import HINGE, SLIDE
from bo_sysid.proof.bodies import rotation

Accelerate: TypeAlias = Callable[[float, float, float, float, float, float], tuple[float, float]]
"""(q0, q1, v0, v1, τ0, τ1) -> (a0, a1), in SI units."""


def two_link_arm(model: mujoco.MjModel) -> Accelerate:
    """Two links in the plane of x and z, hinges about y.

    With absolute angles φ1 = q1, φ2 = q1 + q2 and C(q2) = m2 p·R(q2) a2 (p: the second joint in
    the first link; a1, a2: centres of mass in their links):

        A α1 + C α2 + C' ω2² = τ1 - τ2 + g·(m1 R'(φ1) a1 + m2 R'(φ1) p)
        C α1 + B α2 - C' ω1² = τ2 + m2 g·R'(φ2) a2
    """
    _require(model, ("hinge", "hinge"), axes=((0, 1, 0), (0, 1, 0)))
    (m1, a1, I1), (m2, a2, I2) = _link(model, 0), _link(model, 1)
    p = model.body_pos[model.jnt_bodyid[1]]
    gx, _, gz = (float(g) for g in model.opt.gravity)
    r1, r2 = (float(r) for r in model.dof_armature)
    A = float(I1[1, 1] + m1 * (a1[0] ** 2 + a1[2] ** 2) + m2 * (p[0] ** 2 + p[2] ** 2)) + r1 + r2
    B = float(I2[1, 1] + m2 * (a2[0] ** 2 + a2[2] ** 2)) + r2
    along = m2 * float(p[0] * a2[0] + p[2] * a2[2])
    across = m2 * float(p[0] * a2[2] - p[2] * a2[0])
    hx, hz = (float(x) for x in (m1 * a1 + m2 * p)[[0, 2]])
    kx, kz = (float(x) for x in (m2 * a2)[[0, 2]])

    def accelerate(
        q0: float, q1: float, v0: float, v1: float, t0: float, t1: float
    ) -> tuple[float, float]:
        c1, s1 = cos(q0), sin(q0)
        c2, s2 = cos(q0 + q1), sin(q0 + q1)
        c, s = cos(q1), sin(q1)
        C, slope = along * c + across * s, across * c - along * s
        w1, w2 = v0, v0 + v1
        b1 = t0 - t1 + gx * (hz * c1 - hx * s1) - gz * (hx * c1 + hz * s1) - slope * w2 * w2
        b2 = t1 + gx * (kz * c2 - kx * s2) - gz * (kx * c2 + kz * s2) + slope * w1 * w1
        M12 = C - r2
        det = A * B - M12 * M12
        alpha1 = (B * b1 - M12 * b2) / det
        return alpha1, (A * b2 - M12 * b1) / det - alpha1

    return accelerate


def cart_pole(model: mujoco.MjModel) -> Accelerate:
    """A cart along x with a pole that turns about y; centre of mass a in the pole.

    With k(θ) = R'(θ)a·x and l(θ) = R'(θ)a·z, so that k' = l:

        (mc + mp) x'' + mp k θ'' + mp l θ'² = F + (mc + mp) gx
        mp k x'' + (I + mp |a|²) θ'' = τ + mp (gx k + gz l)
    """
    _require(model, ("slide", "hinge"), axes=((1, 0, 0), (0, 1, 0)))
    (mc, _, _), (mp, a, I) = _link(model, 0), _link(model, 1)
    gx, _, gz = (float(g) for g in model.opt.gravity)
    r1, r2 = (float(r) for r in model.dof_armature)
    ax, az = float(a[0]), float(a[2])
    A = mc + mp + r1
    B = float(I[1, 1]) + mp * (ax**2 + az**2) + r2
    pull = (mc + mp) * gx

    def accelerate(
        q0: float, q1: float, v0: float, v1: float, t0: float, t1: float
    ) -> tuple[float, float]:
        c, s = cos(q1), sin(q1)
        k, l = az * c - ax * s, -ax * c - az * s
        b1 = t0 + pull - mp * l * v1 * v1
        b2 = t1 + mp * (gx * k + gz * l)
        C = mp * k
        det = A * B - C * C
        return (B * b1 - C * b2) / det, (A * b2 - C * b1) / det

    return accelerate


def rotary_pendulum(model: mujoco.MjModel) -> Accelerate:
    """Furuta's pendulum: an arm about z that carries, at (L, 0, 0), a pendulum about its own x.

    With the pendulum's centre of mass at (0, 0, h) and its inertia diagonal (Jx, Jy, Jz) there,
    D = m h² + Jy - Jz:

        (Ia + m L² + Jz + D s²) α'' - m L h c θ'' + 2 D s c α' θ' + m L h s θ'² = τ1 + G1
        -m L h c α'' + (Jx + m h²) θ'' - D s c α'² = τ2 + G2
    """
    _require(model, ("hinge", "hinge"), axes=((0, 0, 1), (1, 0, 0)))
    (ma, a, Ia), (m, b, J) = _link(model, 0), _link(model, 1)
    p = model.body_pos[model.jnt_bodyid[1]]
    off = [p[1], p[2], a[1], a[2], b[0], b[1], *J[~np.eye(3, dtype=bool)]]
    if np.abs(off).max() > 1e-12:
        raise ModelError(
            "rotary_pendulum: the arm must lie along x, the pendulum along z, its inertia diagonal"
        )
    L, h = float(p[0]), float(b[2])
    gx, gy, gz = (float(g) for g in model.opt.gravity)
    r1, r2 = (float(r) for r in model.dof_armature)
    base = float(Ia[2, 2] + ma * (a[0] ** 2 + a[1] ** 2) + m * L**2 + J[2, 2]) + r1
    D = m * h**2 + float(J[1, 1] - J[2, 2])
    B = float(J[0, 0]) + m * h**2 + r2
    mLh, mh, lever = m * L * h, m * h, ma * float(a[0]) + m * L

    def accelerate(
        q0: float, q1: float, v0: float, v1: float, t0: float, t1: float
    ) -> tuple[float, float]:
        ca, sa, c, s = cos(q0), sin(q0), cos(q1), sin(q1)
        ahead, aside = gx * ca + gy * sa, gy * ca - gx * sa  # gravity in the arm's frame
        b1 = t0 + lever * aside + mh * s * ahead - 2 * D * s * c * v0 * v1 - mLh * s * v1 * v1
        b2 = t1 - mh * (c * aside + s * gz) + D * s * c * v0 * v0
        A, C = base + D * s * s, -mLh * c
        det = A * B - C * C
        return (B * b1 - C * b2) / det, (A * b2 - C * b1) / det

    return accelerate


EQUATIONS: Mapping[str, Callable[[mujoco.MjModel], Accelerate]] = MappingProxyType(
    {
        "two_link_arm": two_link_arm,
        "cart_pole": cart_pole,
        "rotary_pendulum": rotary_pendulum,
    }
)
"""Equations by the name of their machine."""


def _link(model: mujoco.MjModel, joint: int) -> tuple[float, np.ndarray, np.ndarray]:
    """Return mass, centre of mass and inertia about it, in the frame of the joint's body.

    Bodies fixed to it, such as a payload, are part of it.
    """
    own = int(model.jnt_bodyid[joint])
    bodies = [own, *(b for b in range(own + 1, model.nbody) if model.body_weldid[b] == own)]
    if any(int(model.body_parentid[b]) != own for b in bodies[1:]):
        raise ModelError("equations of motion: a body fixed to a link must be its child")
    placed = []
    for body in bodies:
        shift = np.zeros(3) if body == own else model.body_pos[body]
        frame = np.eye(3) if body == own else rotation(model.body_quat[body])
        centre = shift + frame @ model.body_ipos[body]
        turn = frame @ rotation(model.body_iquat[body])
        inertia = turn @ np.diag(model.body_inertia[body]) @ turn.T
        placed.append((float(model.body_mass[body]), centre, inertia))
    mass = sum(m for m, _, _ in placed)
    centre = sum((m * c for m, c, _ in placed), np.zeros(3)) / mass
    total = np.zeros((3, 3))
    for m, c, inertia in placed:
        d = c - centre
        total += inertia + m * (d @ d * np.eye(3) - np.outer(d, d))
    return mass, centre, total


def _require(
    model: mujoco.MjModel, kinds: tuple[str, str], axes: tuple[tuple[int, ...], ...]
) -> None:
    """Refuse a model that the equations are not about."""
    known = {HINGE: "hinge", SLIDE: "slide"}
    found = tuple(known.get(int(t), "other") for t in model.jnt_type)
    chained = model.njnt == 2 and int(model.body_parentid[model.jnt_bodyid[1]]) == int(
        model.jnt_bodyid[0]
    )
    straight = not np.any(model.jnt_pos) and np.allclose(model.body_quat[1:, 0], 1)
    if found != kinds or not chained or not straight or not np.allclose(model.jnt_axis, axes):
        raise ModelError(
            f"equations of motion: the model must have a {kinds[0]} along or about {axes[0]} and, "
            f"on its body, a {kinds[1]} about {axes[1]}; it has {', '.join(found) or 'no joints'}"
        )
