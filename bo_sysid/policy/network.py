"""Networks of tanh layers whose parameters live in one flat vector.

One vector is what conjugate gradients, line search, Adam and checkpoints want. The same layout
serves NumPy (roll-outs, critic) and torch (policy update): `layers` only slices and reshapes.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

LOG_2PI = float(np.log(2 * np.pi))


@dataclass(frozen=True)
class Network:
    """A fully connected network: tanh after every layer but the last.

    Attributes:
        sizes: numbers of inputs, of units of each hidden layer, and of outputs.
    """

    sizes: tuple[int, ...]

    @property
    def size(self) -> int:
        """The number of parameters."""
        return sum(o * i + o for i, o in zip(self.sizes, self.sizes[1:], strict=False))

    def layers(self, theta: Any) -> list[tuple[Any, Any]]:
        """Return views (weight `out x in`, bias `out`) of each layer.

        Args:
            theta: at least `size` parameters, a NumPy array or a torch tensor.
        """
        views, start = [], 0
        for i, o in zip(self.sizes, self.sizes[1:], strict=False):
            weight = theta[start : start + o * i].reshape(o, i)
            views.append((weight, theta[start + o * i : start + o * i + o]))
            start += o * i + o
        return views

    def initial(self, rng: np.random.Generator, last_gain: float) -> Float[np.ndarray, " p"]:
        """Return orthogonal weights and zero biases, float32.

        Hidden layers have gain sqrt(2), the last one `last_gain` (Saxe et al. 2014).
        """
        theta = np.zeros(self.size, np.float32)
        views = self.layers(theta)
        for k, (weight, _) in enumerate(views):
            gain = last_gain if k == len(views) - 1 else np.sqrt(2.0)
            weight[:] = gain * _orthogonal(rng, *weight.shape)
        return theta

    def __call__(
        self, theta: Float[np.ndarray, " p"], x: Float[np.ndarray, "n inputs"]
    ) -> Float[np.ndarray, "n outputs"]:
        """Return the outputs at `n` inputs, in NumPy."""
        views = self.layers(theta)
        for weight, bias in views[:-1]:
            x = x @ weight.T
            x += bias
            np.tanh(x, out=x)
        weight, bias = views[-1]
        return np.asarray(x @ weight.T + bias)


@dataclass(frozen=True)
class GaussianPolicy:
    """A normal distribution of actions with a network's mean and a spread of its own.

    The parameter vector holds the network's, then the logarithms of the standard deviations, which
    do not depend on the observation.

    Attributes:
        network: from normalised observations to mean actions.
    """

    network: Network

    @classmethod
    def of_size(cls, observations: int, actions: int, hidden: tuple[int, ...]) -> "GaussianPolicy":
        """Return a policy with the given numbers of inputs, outputs and hidden units."""
        return cls(Network((observations, *hidden, actions)))

    @property
    def actions(self) -> int:
        """The number of action dimensions."""
        return self.network.sizes[-1]

    @property
    def size(self) -> int:
        """The number of parameters."""
        return self.network.size + self.actions

    def initial(self, rng: np.random.Generator, log_std: float = 0.0) -> Float[np.ndarray, " p"]:
        """Return parameters of a policy that is near zero on average, float32."""
        log_stds = np.full(self.actions, log_std, np.float32)
        return np.concatenate([self.network.initial(rng, last_gain=0.01), log_stds])

    def log_std(self, theta: Any) -> Any:
        """Return the view of the logarithms of the standard deviations."""
        return theta[self.network.size : self.size]


def _orthogonal(
    rng: np.random.Generator, rows: int, columns: int
) -> Float[np.ndarray, "rows columns"]:
    """Return a random matrix with orthonormal rows or columns, whichever are fewer."""
    tall = rng.standard_normal((max(rows, columns), min(rows, columns)))
    q, r = np.linalg.qr(tall)
    q *= np.sign(np.diag(r))  # uniform over orthogonal matrices
    return q if rows >= columns else q.T
