"""Random-phase multisines, with which informative controls are compared.

[Pintelon2012] R. Pintelon, J. Schoukens. System Identification: A Frequency Domain Approach.
Wiley, 2012; random-phase multisines: chapter 5.
"""

import numpy as np
from jaxtyping import Float

from bo_sysid.excite.judge import largest
from bo_sysid.excite.trial import Trial

_LARGEST = 4.0  # amplitude that random tones are tried from, in half ranges


def multisines(
    trial: Trial, count: int, seed: int, band: tuple[float, float]
) -> Float[np.ndarray, "K R nu"]:
    """Return random-phase multisines, as large as the limits of all machines allow.

    All lines k / T in the band have the same amplitude and random phases [Pintelon2012];
    actuators move by the same share of their ranges.

    Args:
        trial: of the machine.
        count: number K of multisines.
        seed: of the phases.
        band: lowest and highest frequency in [Hz].
    """
    rng, s = np.random.default_rng(seed), trial.series
    low, high = np.ceil(band[0] * s.seconds - 1e-9), np.floor(band[1] * s.seconds + 1e-9)
    turns = 2 * np.pi * s.time[:, None] * np.arange(max(low, 1), high + 1) / s.seconds
    phase = rng.uniform(0, 2 * np.pi, (count, len(s.half), 1, turns.shape[1]))
    unit = np.cos(turns + phase).sum(axis=3)
    unit /= np.sqrt((unit**2).mean(axis=2, keepdims=True))
    shape = s.fade[:, None] * np.swapaxes(unit, 1, 2)

    everyone = tuple(range(len(trial.machines)))

    def over(size: np.ndarray) -> np.ndarray:
        return trial.judge(everyone)(
            s.scaled(size[:, None, None] * shape), 1.0, information=False
        ).over

    size = largest(over, np.full(count, _LARGEST), 10)
    unit = size[:, None, None] * shape
    return np.stack([trial.safe(u) for u in unit])  # judges are coarse
