"""What effects do to the predictions of a recording, in sigma: by that they are drawn and counted.

The size is the projected rms difference over windows of 0.3 s (0.1 s in contact), in units of the
sensor noise.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bo_sysid.diagnosis.windows.candidate import Candidate
from bo_sysid.diagnosis.windows.cutting import cut_problem
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.diagnosis.windows.projection import project
from bo_sysid.diagnosis.windows.windowing import nothing, prepare
from bo_sysid.effects import Machine
from bo_sysid.mjcf import Model
from bo_sysid.mjcf.touching import can_touch
from bo_sysid.recording import Recording
from bo_sysid.simulation import Engine

_WINDOW = 0.3  # [s] in which an effect is sized
_TOUCHING = 0.1  # [s] the same where geoms can touch
_NO_SIZE = 1e-3  # [sigma]
_SOFTEST = 0.5  # of the softest gear that is looked for: no softer one is drawn
_ALIKE = 0.98  # cosine of the differences that two effects make, that is one effect


class Sizes:
    """Measures what effects do to the predictions of a recording, in sigma.

    Args:
        model: the nominal model.
        machine: its scales.
        recording: in which the effects act.
        sigma: noise of the positions.
    """

    def __init__(self, model: Model, machine: Machine, recording: Recording, sigma: float) -> None:
        channels = {n: sigma for n in recording.channels if n.startswith("qpos.")}
        window = _TOUCHING if can_touch(machine.model) else _WINDOW
        horizon = round(window / machine.sampling)
        problem = cut_problem(
            model,
            machine,
            [recording],
            channels,
            (),
            horizon=horizon,
            keep_every=3,
            engine=Engine(1),
        )
        self._prepared = prepare(problem)
        self._problem = replace(self._prepared.problem, correction=None)
        self._base = self._problem.residual(nothing(problem), self._prepared.start)

    def of(self, c: Candidate, x: np.ndarray) -> float:
        """Return the rms projected difference that an effect makes."""
        return float(np.sqrt((self._made(c, x) ** 2).sum() / self._problem.dof))

    def alike(self, drawn: Sequence[tuple[Candidate, np.ndarray]]) -> bool:
        """Whether two effects make the same difference, up to its size: no recording parts them."""
        one, two = (self._made(c, x).ravel() for c, x in drawn)
        return bool(abs(one @ two) > _ALIKE * np.linalg.norm(one) * np.linalg.norm(two))

    def _made(self, c: Candidate, x: np.ndarray) -> np.ndarray:
        r = self._problem.residual(Hypothesis((c,), (x,)), self._prepared.start)
        return project(self._prepared.linear.Q, r - self._base)

    def seen(self, c: Candidate, x: Sequence[float]) -> np.ndarray:
        """Return the magnitudes without what no prediction shows, as a shift out of the plane."""
        own = np.array(x[: c.size])
        if c.effect.vector < 2:
            return own
        return own * [self.of(c, part) > _NO_SIZE for part in np.diag(own)]

    def scaled(self, c: Candidate, target: float, share: float) -> np.ndarray | None:
        """Return the magnitudes at which an effect makes `target` sigma, None where none do.

        Args:
            c: the effect at its site.
            target: in sigma.
            share: of a joint's damping that acts on the link, where the effect adds a joint; of
                those its gap or compliance alone is sized.
        """
        x = c.point[: c.size].copy()
        sized = np.ones(len(x), bool)
        if c.effect.hidden:
            sized[1:], x[-1] = False, share
        for _ in range(8):
            size = self.of(c, x)
            if not np.isfinite(size) or size <= 0:
                x = np.where(sized, 2 * x, x)
                continue
            factor = np.clip(target / size, 0.2, 5.0)
            x = np.where(sized, x * (np.sqrt(factor) if c.effect.threshold else factor), x)
            if abs(factor - 1) < 0.05:
                break
        part = _SOFTEST if c.effect.id == "joint_compliance" else 1.0
        most = np.where(sized, part * c.high, c.high)
        inside = (x >= c.low).all() and (x <= most).all()
        near = inside and abs(np.log(max(self.of(c, x), 1e-9) / target)) < 0.3
        return x if near else None
