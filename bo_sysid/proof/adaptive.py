"""Tier 3: a plant that is not MuJoCo, equations of motion under SciPy's adaptive solver.

Between two changes of a command the right-hand side is continuous; the solver (DOP853, Hairer,
Nørsett and Wanner, "Solving Ordinary Differential Equations I") is restarted at each change, also
at those that a delay puts between two samples. Gaps, dead zones and limits are kinks, at which it
shortens its steps by itself.
"""

from itertools import pairwise

import mujoco
import numpy as np
from scipy.integrate import DOP853

from bo_sysid.errors import ModelError
from bo_sysid.proof.equations import Accelerate
from bo_sysid.proof.physics import Physics
from bo_sysid.proof.rolled import Command, PlantDiverged, Rolled, encoder_readings, rolled

RELATIVE, ABSOLUTE = 1e-8, 1e-10
"""Tolerances of the solver."""

_FAR = 1e3  # [rad] or [m]


class AdaptivePlant:
    """Integrates a plant of two joints.

    Args:
        physics: of the plant.
        accelerate: equations of motion, with the masses and inertias of `physics.model`.

    Raises:
        ModelError: the model has what the equations do not: dry friction, limits, contact.
    """

    def __init__(self, physics: Physics, accelerate: Accelerate) -> None:
        m = physics.model
        _require_smooth(m)
        self.physics, self._accelerate, self._n = physics, accelerate, int(m.nv)
        self._damping = [float(d) for d in m.dof_damping]
        self._stiffness = [float(k) for k in m.jnt_stiffness]
        self._rest = [float(q) for q in m.qpos_spring]
        self._lags = [a for a, d in enumerate(physics.drives) if d.lag > 0]
        self._u: list[float] = [0.0] * len(physics.drives)  # behind delay and dead zone

    def roll(self, command: Command, steps: int, timestep: float) -> Rolled:
        """Run the plant from rest at the model's reference positions.

        Args:
            command: asked at every row.
            steps: number of rows T.
            timestep: between two rows in [s].

        Raises:
            PlantDiverged: it went out of every bound.
        """
        n, physics = self._n, self.physics
        size = 2 * n + len(self._lags) + len(physics.bristles) + 2 * bool(physics.transmission)
        y = np.zeros(size)
        y[:n] = physics.model.qpos0
        if physics.transmission:
            y[-2] = y[physics.transmission.dof]
        time = np.arange(steps) * timestep
        states, ctrl = np.empty((steps, size)), np.empty((steps, len(physics.drives)))
        first = timestep
        for k in range(steps):
            states[k] = y
            rotor = states[: k + 1, -2:] if physics.transmission else None
            ctrl[k] = command(
                k, encoder_readings(physics, states[: k + 1, : 2 * n], timestep, rotor)
            )
            if k == 0:
                for i, a in enumerate(self._lags):
                    y[2 * n + i] = physics.drives[a].command(ctrl[0, a])
            if k + 1 < steps:
                y, first = self._advance(y, ctrl[: k + 1], k, timestep, first)
        rotor_states = states[:, -2:] if physics.transmission else None
        return rolled(physics, time, states[:, : 2 * n], ctrl, rotor_states)

    def _advance(
        self, y: np.ndarray, ctrl: np.ndarray, k: int, timestep: float, first: float
    ) -> tuple[np.ndarray, float]:
        """Integrate from row k to the next, in pieces with constant commands."""
        drives = self.physics.drives
        whole = [int(d.delay / timestep) for d in drives]
        breaks = [d.delay - w * timestep for d, w in zip(drives, whole, strict=True)]
        edges = sorted({0.0, timestep, *(b for b in breaks if 1e-12 < b < timestep)})
        begin = k * timestep
        for low, high in pairwise(edges):
            for a, drive in enumerate(drives):
                row = k - whole[a] - (1 if low + 1e-12 < breaks[a] else 0)
                self._u[a] = drive.command(float(ctrl[max(row, 0), a]))
            y, first = self._solve(begin + low, begin + high, y, first)
        return y, first

    def _solve(
        self, start: float, stop: float, y: np.ndarray, first: float
    ) -> tuple[np.ndarray, float]:
        solver = DOP853(
            self._derivative, start, y, stop,
            rtol=RELATIVE, atol=ABSOLUTE, first_step=min(first, stop - start),
        )  # fmt: skip
        while solver.status == "running":
            solver.step()
        if solver.status == "failed" or not np.abs(solver.y).max() < _FAR:
            raise PlantDiverged(f"the plant diverged at {stop:g} s")
        return solver.y, float(solver.h_abs)

    def _derivative(self, t: float, y: np.ndarray) -> np.ndarray:
        physics, n = self.physics, self._n
        s = y.tolist()
        q, v = s[:n], s[n : 2 * n]
        extra: list[float] = []
        force = [
            -d * x - k * (p - r)
            for d, x, k, p, r in zip(self._damping, v, self._stiffness, q, self._rest, strict=True)
        ]
        driven, seat = [0.0] * n, 2 * n
        link = physics.transmission
        for a, drive in enumerate(physics.drives):
            u = self._u[a]
            if drive.lag > 0:
                u = s[seat]
                extra.append((self._u[a] - u) / drive.lag)
                seat += 1
            j = drive.dof
            turned = link is not None and link.dof == j and physics.encoders[j].motor_side
            at, speed = (s[-2], s[-1]) if turned else (q[j], v[j])
            driven[j] += drive.force(u, at, speed)
        for law in physics.laws:
            force[law.dof] += law.force(t, q, v, driven)
        for bristle in physics.bristles:
            z, speed = s[seat], v[bristle.dof]
            dz = (speed - abs(speed) * z) / bristle.yields
            force[bristle.dof] -= bristle.level(t, q, v, driven) * (z + bristle.damping * dz)
            extra.append(dz)
            seat += 1
        if link is not None:
            passed = link.force(s[-2] - q[link.dof], s[-1] - v[link.dof])
            extra += [s[-1], (driven[link.dof] - passed) / link.inertia]
            driven[link.dof] = passed
        a0, a1 = self._accelerate(
            q[0], q[1], v[0], v[1], force[0] + driven[0], force[1] + driven[1]
        )
        return np.array([*v, a0, a1, *extra])


def _require_smooth(model: mujoco.MjModel) -> None:
    limited = np.any(model.jnt_limited) or np.any(model.actuator_forcelimited)
    touching = model.ngeom and np.any((model.geom_contype != 0) & (model.geom_conaffinity != 0))
    medium = model.opt.density or model.opt.viscosity or np.any(model.opt.wind)
    if np.any(model.dof_frictionloss) or limited or touching or medium or model.neq or model.na:
        raise ModelError(
            "equations of motion: dry friction, limits, contact, fluids, equalities and actuator "
            "states of the model are not in them"
        )
