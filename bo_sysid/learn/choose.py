"""Which candidate the policy is learned on.

Every choice takes P(β), `N`, which need not be normalised; the `N` posterior means of g(Δ(β)), in
units of g; and a generator, which only `sample` uses. It returns the row of B.
"""

from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Float

from bo_sysid.arrays import Probabilities

Choice = Callable[
    [Probabilities, Float[np.ndarray, " N"], np.random.Generator],
    int,
]
"""From P(β), the mean of g(Δ(β)) and a generator to the row of B.

g is the power of Δ that the surrogate models; see `bo_sysid.belief.warp`.
"""


def sample(
    probabilities: Probabilities, mean: Float[np.ndarray, " N"], rng: np.random.Generator
) -> int:
    """Draw β ~ P, the seed method's choice (Thompson sampling): explores while P is broad."""
    return int(rng.choice(len(probabilities), p=probabilities / probabilities.sum()))


def argmax(
    probabilities: Probabilities, mean: Float[np.ndarray, " N"], rng: np.random.Generator
) -> int:
    """Return argmax P: the choice of Zhu et al. (IJCAI 2018)."""
    return int(probabilities.argmax())


def minimum_mean(
    probabilities: Probabilities, mean: Float[np.ndarray, " N"], rng: np.random.Generator
) -> int:
    """Return the row whose expected g(Δ) is least."""
    return int(mean.argmin())


CHOOSE: Mapping[str, Choice] = {"sample": sample, "argmax": argmax, "minimum-mean": minimum_mean}
"""Choices by the name that studies give them."""
