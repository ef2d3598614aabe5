"""Tier 2: MuJoCo with another step and integrator, the concealed forces stepped by hand.

Laws of force are evaluated at every step of the plant and handed over as applied forces; a bristle
of friction advances by the exact solution of its equation over the step, for the velocity at its
beginning; commands pass delay, dead zone and lag outside MuJoCo. Only gains, biases and limits of
actuators are written into the compiled model.
"""

from dataclasses import dataclass
from math import exp, floor
from typing import Literal

import mujoco
import numpy as np

from bo_sysid.errors import ModelError
from bo_sysid.proof.bodies import copy_model
from bo_sysid.proof.physics import Bristle, Drive, Physics
from bo_sysid.proof.rolled import Command, PlantDiverged, Rolled, encoder_readings, rolled

Integrator = Literal["Euler", "RK4", "implicit", "implicitfast"]

_FAR = 1e3


@dataclass(frozen=True)
class Stepping:
    """How the plant's simulator differs from the model's.

    Attributes:
        divide: steps of the plant between two rows of the recording.
        integrator: of the plant.
    """

    divide: int
    integrator: Integrator


class SteppedPlant:
    """Steps a plant of hinges and slides.

    Args:
        physics: of the plant.
        stepping: its step and integrator.

    Raises:
        ModelError: it has a rotor of its own, which only the equations of motion have.
    """

    def __init__(self, physics: Physics, stepping: Stepping) -> None:
        if physics.transmission is not None:
            raise ModelError("a plant with a rotor of its own is integrated, not stepped")
        self.physics, self._stepping = physics, stepping
        model = self.model = _with_drives(physics)
        model.opt.integrator = getattr(mujoco.mjtIntegrator, _INTEGRATORS[stepping.integrator])
        self._by_hand = bool(
            physics.laws or physics.bristles or any(d.lag or d.delay for d in physics.drives)
        )

    def roll(self, command: Command, steps: int, timestep: float) -> Rolled:
        """Run the plant from rest; see `AdaptivePlant.roll`."""
        model, drives = self.model, self.physics.drives
        model.opt.timestep = timestep / self._stepping.divide
        data = mujoco.MjData(model)
        bristles = [0.0] * len(self.physics.bristles)
        filtered = [0.0] * len(drives)
        n = int(model.nv)
        states, ctrl = np.empty((steps, 2 * n)), np.empty((steps, len(drives)))
        for k in range(steps):
            states[k, :n], states[k, n:] = data.qpos, data.qvel
            ctrl[k] = command(k, encoder_readings(self.physics, states[: k + 1], timestep))
            if k == 0:
                filtered = [d.command(float(u)) for d, u in zip(drives, ctrl[0], strict=True)]
            if k + 1 == steps:
                break
            if self._by_hand:
                for part in range(self._stepping.divide):
                    self._step(data, ctrl[: k + 1], part, bristles, filtered)
            else:
                data.ctrl[:] = [
                    _settled(d, d.command(float(u))) for d, u in zip(drives, ctrl[k], strict=True)
                ]
                mujoco.mj_step(model, data, self._stepping.divide)
            # MuJoCo restarts a simulation that diverges: its time falls back
            if data.time < (k + 0.5) * timestep or not np.abs(data.qpos).max() < _FAR:
                raise PlantDiverged(f"the plant diverged at {k * timestep:g} s")
        return rolled(self.physics, np.arange(steps) * timestep, states, ctrl)

    def _step(
        self,
        data: mujoco.MjData,
        ctrl: np.ndarray,
        part: int,
        bristles: list[float],
        filtered: list[float],
    ) -> None:
        """Advance by one step of the plant; changes the bristles and the lags' states."""
        physics, dt, divide = self.physics, self.model.opt.timestep, self._stepping.divide
        now = (len(ctrl) - 1) * divide + part
        q, v = data.qpos.tolist(), data.qvel.tolist()
        force, load = [0.0] * len(v), [0.0] * len(v)
        for a, drive in enumerate(physics.drives):
            u = _arrived(drive, ctrl[:, a], now - drive.delay / dt, divide)
            if drive.lag > 0:
                rest = exp(-dt / drive.lag)
                begin, filtered[a] = filtered[a], u + (filtered[a] - u) * rest
                u += (begin - u) * (drive.lag / dt) * (1.0 - rest)  # mean over the step
            data.ctrl[a] = _settled(drive, u)
            load[drive.dof] += drive.force(u, q[drive.dof], v[drive.dof])
        for law in physics.laws:
            force[law.dof] += law.force(now * dt, q, v, load)
        for i, bristle in enumerate(physics.bristles):
            z, mean = _bristle(bristle, bristles[i], v[bristle.dof], dt)
            slip = (z - bristles[i]) / dt
            level = bristle.level(now * dt, q, v, load)
            force[bristle.dof] -= level * (mean + bristle.damping * slip)
            bristles[i] = z
        data.qfrc_applied[:] = force
        mujoco.mj_step(self.model, data)


def _arrived(drive: Drive, ctrl: np.ndarray, at: float, divide: int) -> float:
    """Return the mean over a step of the command that left at `at`, in steps of the plant."""
    step = floor(at + 1e-9)
    part = max(at - step, 0.0)
    old, new = (
        drive.command(float(ctrl[min(max(k // divide, 0), ctrl.size - 1)]))
        for k in (step, step + 1)
    )
    return (1.0 - part) * old + part * new


_INTEGRATORS = {
    "Euler": "mjINT_EULER",
    "RK4": "mjINT_RK4",
    "implicit": "mjINT_IMPLICIT",
    "implicitfast": "mjINT_IMPLICITFAST",
}


def _bristle(bristle: Bristle, z: float, v: float, dt: float) -> tuple[float, float]:
    """Return the bristle's deflection after a step at speed v, and its mean over the step.

    dz/dt = (v - |v| z)/δ has the solution z = s + (z0 - s) exp(-|v| t/δ) with s = sign v.
    """
    rate = abs(v) / bristle.yields * dt
    if rate < 1e-8:
        return z + v / bristle.yields * dt * (1.0 - abs(z)), z
    s = 1.0 if v > 0 else -1.0
    rest = exp(-rate)
    return s + (z - s) * rest, s + (z - s) * (1.0 - rest) / rate


def _settled(drive: Drive, u: float) -> float:
    """Return the command that stands for a servo's encoder offset as well."""
    return u if not drive.offset else u + drive.bias[1] * drive.gear * drive.offset / drive.gain


def _with_drives(physics: Physics) -> mujoco.MjModel:
    """Return a copy of the plant's model with gains, biases and limits of the drives."""
    model = copy_model(physics.model)
    for a, drive in enumerate(physics.drives):
        b0, b1, b2 = drive.bias
        model.actuator_gainprm[a, 0] = drive.gain
        if drive.servo or any(drive.bias):
            model.actuator_biasprm[a, :3] = (b0, b1 * (1.0 + drive.scale), b2)
        if np.isfinite(drive.limit):
            most = drive.limit / abs(drive.gear)
            model.actuator_forcelimited[a] = 1
            model.actuator_forcerange[a] = (-most, most)
    return model
