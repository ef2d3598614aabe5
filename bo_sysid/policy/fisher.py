"""Products with the Fisher matrix of a Gaussian policy, without automatic differentiation.

For a normal policy with mean mu(s; theta) and standard deviations exp(l), the Hessian of the mean
KL divergence at equal policies is

    F = 1/B sum_b [ J_b' diag(exp(-2 l)) J_b ]  for the network,    2 I  for l,

with J_b = d mu(s_b) / d theta (Schulman et al. 2015, appendix C). F v is one forward pass of the
tangent J v and one backward pass; half the work of differentiating the KL divergence twice. Where
the KL divergence is averaged over the A action dimensions, F is divided by A.
"""

import torch

from bo_sysid.policy.network import GaussianPolicy

CHUNK = 4096  # rows; intermediate results stay in cache


class Fisher:
    """The damped Fisher matrix at given parameters, as a product.

    Args:
        policy: the layout of the parameters.
        theta: parameters, float32.
        observations: `B x o` normalised observations.
        damping: added to the diagonal.
        average: the KL divergence is averaged over action dimensions, else summed.
    """

    def __init__(
        self,
        policy: GaussianPolicy,
        theta: torch.Tensor,
        observations: torch.Tensor,
        *,
        damping: float,
        average: bool,
    ) -> None:
        self._policy, self._damping = policy, damping
        self._layers = policy.network.layers(theta)
        self._scale = 1.0 / (policy.actions if average else 1)
        self._weight = torch.exp(-2 * policy.log_std(theta)) * (self._scale / len(observations))
        self._chunks = [self._activations(x) for x in torch.split(observations, CHUNK)]

    def _activations(self, x: torch.Tensor) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
        """Return each layer's inputs, and the slopes tanh' = 1 - tanh^2 that led to all but x."""
        inputs, slopes = [x], list[torch.Tensor]()
        for weight, bias in self._layers[:-1]:
            inputs.append(torch.tanh(torch.addmm(bias, inputs[-1], weight.T)))
            slopes.append(1 - inputs[-1] ** 2)
        return inputs, slopes

    def __call__(self, v: torch.Tensor) -> torch.Tensor:
        """Return (F + damping I) v, float64, for a vector v of all parameters."""
        direction = v.to(self._weight.dtype)
        result = torch.zeros_like(direction)
        tangents = self._policy.network.layers(direction)
        gradients = self._policy.network.layers(result)
        for inputs, slopes in self._chunks:
            self._add(inputs, slopes, tangents, gradients)
        self._policy.log_std(result)[:] = 2 * self._scale * self._policy.log_std(direction)
        return result.to(torch.float64) + self._damping * v

    def _add(
        self,
        inputs: list[torch.Tensor],
        slopes: list[torch.Tensor],
        tangents: list[tuple[torch.Tensor, torch.Tensor]],
        gradients: list[tuple[torch.Tensor, torch.Tensor]],
    ) -> None:
        """Add one chunk's J' diag(weight) J v."""
        change, bias = tangents[0]
        d = torch.addmm(bias, inputs[0], change.T)
        for k in range(1, len(inputs)):
            d *= slopes[k - 1]
            change, bias = tangents[k]
            d = torch.addmm(bias, d, self._layers[k][0].T).addmm_(inputs[k], change.T)
        back = d.mul_(self._weight)
        for k in reversed(range(len(inputs))):
            weight, bias = gradients[k]
            weight.addmm_(back.T, inputs[k])
            bias.add_(back.sum(dim=0))
            if k > 0:
                back = back @ self._layers[k][0]
                back *= slopes[k - 1]
