"""How large concealed physics is: what it does to predictions, in standard deviations of a sensor.

The size of an effect is the root mean square of recorded minus predicted, free of noise and over
the sensor's σ, in windows of 0.3 s whose starts are fitted, as any diagnosis must; what predicts is
the plant without the effect. A shift that another start would explain does not count. Machines
with contact take short windows and the median over them, since windows in which contact decides
differ by any amount.
"""

from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float
from mujoco.batch import Batch

from bo_sysid.proof.rolled import Rolled

HORIZON, CONTACT_HORIZON = 0.3, 0.12
"""Length of the windows in [s]."""

_WINDOWS = 16
_STEPS = (1e-6, 1e-5)  # of finite differences, in position and velocity
_FITS = 2


@dataclass(frozen=True)
class Reference:
    """The plant without what is concealed, in MuJoCo.

    Attributes:
        model: with the plant's true parameters.
        divide: its steps between two rows of a recording.
        horizon: of the windows in [s].
        contact: whether the median over windows is taken.
    """

    model: mujoco.MjModel
    divide: int
    horizon: float = HORIZON
    contact: bool = False

    def size(self, rolled: Rolled, sigma: Float[np.ndarray, " n"]) -> float:
        """Return the size of what a trajectory has and the reference lacks.

        Args:
            rolled: of the plant with everything concealed.
            sigma: noise of each encoder.
        """
        dt = float(rolled.time[1] - rolled.time[0])
        length = max(round(self.horizon / dt), 4)
        rows = np.linspace(1, len(rolled.time) - length - 1, _WINDOWS).astype(int)
        span = rows[:, None] + np.arange(length)
        observed, ctrl = rolled.read[span] / sigma, rolled.ctrl[span]
        q, v = rolled.read[rows], rolled.qvel[rows]
        n = q.shape[1]
        for _ in range(_FITS):
            J = self._jacobian(q, v, ctrl, dt) / sigma[:, None]
            J = J.reshape(_WINDOWS, -1, 2 * n)
            r = (observed - self._predict(q, v, ctrl, dt) / sigma).reshape(_WINDOWS, -1)
            step = np.stack(
                [np.linalg.lstsq(j, x, rcond=1e-10)[0] for j, x in zip(J, r, strict=True)]
            )
            left = r - np.einsum("wij,wj->wi", J, step)
            q, v = q + step[:, :n], v + step[:, n:]
        squares = np.mean(left**2, axis=1)
        return float(np.sqrt(np.median(squares) if self.contact else np.mean(squares)))

    def _jacobian(self, q: np.ndarray, v: np.ndarray, ctrl: np.ndarray, dt: float) -> np.ndarray:
        n = q.shape[1]
        eye = np.eye(n)
        starts = [(q, v)]
        starts += [(q + _STEPS[0] * e, v) for e in eye] + [(q, v + _STEPS[1] * e) for e in eye]
        tiled = np.concatenate([ctrl] * len(starts))
        y = self._predict(
            np.concatenate([s[0] for s in starts]),
            np.concatenate([s[1] for s in starts]),
            tiled,
            dt,
        ).reshape(2 * n + 1, *ctrl.shape[:2], n)
        widths = np.repeat(_STEPS, n)
        slopes: np.ndarray = (y[1:] - y[0]) / widths[:, None, None, None]
        return np.asarray(np.moveaxis(slopes, 0, -1))

    def _predict(self, q: np.ndarray, v: np.ndarray, ctrl: np.ndarray, dt: float) -> np.ndarray:
        """Return positions `W x H x n` at the rows of the windows, the start first."""
        self.model.opt.timestep = dt / self.divide
        batch = Batch(self.model, nsim=len(q), nthread=1)
        batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
        batch.qpos, batch.qvel = q, v
        held = np.repeat(ctrl[:, :-1], self.divide, axis=1)
        traced = batch.rollout(held.shape[1], control=held, record=("qpos",))["qpos"]
        later = traced[:, self.divide - 1 :: self.divide]
        return np.asarray(np.clip(np.concatenate([q[:, None], later], axis=1), -1e6, 1e6))
