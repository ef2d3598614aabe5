"""The value function: a network fitted by Adam on minibatches.

Written in NumPy with buffers made once: a minibatch of 128 rows is so small that the overhead of
a deep-learning framework is most of its time.
"""

import numpy as np
from jaxtyping import Float

from bo_sysid.policy.network import Network
from bo_sysid.policy.settings import CriticFit


class Critic:
    """A network for values, with the state of Adam (Kingma & Ba 2015).

    Attributes:
        network: from normalised observations to one value.
        theta: `p` parameters, float32; changed in place by `fit`.
    """

    def __init__(self, network: Network, theta: Float[np.ndarray, " p"]) -> None:
        self.network, self.theta = network, theta
        self._first, self._second = np.zeros_like(theta), np.zeros_like(theta)
        self._steps = 0
        self._gradient = np.zeros_like(theta)
        self._scratch = np.zeros_like(theta)

    def values(self, observations: Float[np.ndarray, "n o"]) -> Float[np.ndarray, " n"]:
        """Return the values of `n x o` normalised observations, `n`."""
        return self.network(self.theta, observations)[:, 0]

    def fit(
        self,
        observations: Float[np.ndarray, "B o"],
        targets: Float[np.ndarray, " B"],
        settings: CriticFit,
        rng: np.random.Generator,
    ) -> float:
        """Minimise the mean squared error to `targets`; return its mean over the last epoch.

        Args:
            observations: `B x o`, normalised, float32.
            targets: `B`, float32.
            settings: of the fit.
            rng: shuffles the rows before every epoch.
        """
        loss = 0.0
        for _ in range(settings.epochs):
            order = rng.permutation(len(targets))
            x, y = observations[order], targets[order]
            loss = 0.0
            for start in range(0, len(y), settings.minibatch):
                rows = slice(start, start + settings.minibatch)
                loss += self.gradient(x[rows], y[rows]) * len(y[rows])
                self._adam(settings)
        return loss / len(targets)

    def gradient(self, x: Float[np.ndarray, "B o"], y: Float[np.ndarray, " B"]) -> float:
        """Compute the gradient of mean (V(x) - y)^2 over `theta` into a buffer; return the loss."""
        layers = self.network.layers(self.theta)
        outputs = [x]
        for weight, bias in layers[:-1]:
            z = outputs[-1] @ weight.T
            z += bias
            outputs.append(np.tanh(z, out=z))
        weight, bias = layers[-1]
        error = outputs[-1] @ weight.T
        error += bias
        error[:, 0] -= y
        back = error * np.float32(2 / len(y))
        gradients = self.network.layers(self._gradient)
        for k in reversed(range(len(layers))):
            np.matmul(back.T, outputs[k], out=gradients[k][0])
            np.sum(back, axis=0, out=gradients[k][1])
            if k > 0:
                back = back @ layers[k][0]
                slope = outputs[k]
                slope *= slope
                back *= np.subtract(1, slope, out=slope)  # tanh' = 1 - tanh^2
        return float(np.dot(error[:, 0], error[:, 0])) / len(y)

    def _adam(self, settings: CriticFit) -> None:
        self._steps += 1
        a, b = settings.decays
        g, work = self._gradient, self._scratch
        self._first *= np.float32(a)
        self._first += np.multiply(g, np.float32(1 - a), out=work)
        self._second *= np.float32(b)
        np.multiply(g, g, out=work)
        self._second += np.multiply(work, np.float32(1 - b), out=work)
        np.sqrt(self._second, out=work)
        work *= np.float32(1 / np.sqrt(1 - b**self._steps))
        work += np.float32(settings.epsilon)
        np.divide(self._first, work, out=work)
        work *= np.float32(settings.rate / (1 - a**self._steps))
        self.theta -= work

    def get_state(self) -> dict[str, np.ndarray]:
        """Return copies of the parameters and of the state of Adam."""
        return {
            "theta": self.theta.copy(),
            "first": self._first.copy(),
            "second": self._second.copy(),
            "steps": np.array(self._steps),
        }

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Restore the state that `get_state` returned."""
        self.theta[:] = state["theta"]
        self._first[:] = state["first"]
        self._second[:] = state["second"]
        self._steps = int(state["steps"])
