"""A simulator with a solution on paper, behind the same protocol."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from bo_sysid.arrays import Points
from bo_sysid.parameters import Parameter
from bo_sysid.recording import kind_of
from bo_sysid.simulation.simulator import Prediction
from bo_sysid.simulation.state import State
from bo_sysid.simulation.windows import Windows


@dataclass(frozen=True)
class Oscillator:
    """A damped oscillator of unit mass without control, q'' = -k q - 2 δ q'.

    Attributes:
        parameters: stiffness k in [1/s²] and damping δ in [1/s], in this order; underdamped.
    """

    parameters: tuple[Parameter, ...]

    def predictions(
        self, points: Points, windows: Windows, starts: Sequence[State] | None = None
    ) -> Iterator[Prediction]:
        """Yield q and q' at the instants of the windows.

        With w = √(k - δ²): q(t) = e^{-δt} (q0 cos wt + (v0 + δ q0)/w sin wt).
        """
        t = (windows.step + windows.fraction) * windows.timestep
        for i, (k, d) in enumerate(points):
            start = windows.start if starts is None else starts[i]
            q0, v0 = start.qpos[:, :1], start.qvel[:, :1]
            w = np.sqrt(k - d**2)
            a, b = q0, (v0 + d * q0) / w
            decay, c, s = np.exp(-d * t), np.cos(w * t), np.sin(w * t)
            q = decay * (a * c + b * s)
            v = decay * ((b * w - d * a) * c - (a * w + d * b) * s)
            values = {"qpos": q, "qvel": v}
            columns = [values[kind_of(name)] for name in windows.channels]
            yield Prediction(np.stack(columns, axis=-1), np.zeros(len(windows), bool))

    @property
    def following(self) -> Int[np.ndarray, " k"]:
        """None: there are no closed chains."""
        return np.zeros(0, np.intp)

    def moved(self, start: State, tangent: Float[np.ndarray, "W n"]) -> State:
        """Return starts moved by changes of position and velocity."""
        return State(start.qpos + tangent[:, :1], start.qvel + tangent[:, 1:], start.act)
