"""Noise of recorded inputs, as what it does to windows.

A torque that was measured with noise moves the simulation as the machine was not moved. To first
order about a course n₀ of the noise the residual of a window holds, beside the sensors' own,
A (ξ - ξ₀) with A the response to noise of size 1, ξ ~ N(0, I), and ξ₀ what n₀ is made of. A ξ₀ is
added to it, and residuals are weighted by the inverse root of what is then their covariance,

    (I + A Aᵀ)^-½ = I - U (I - (I + S²)^-½) Uᵀ    with A = U S Vᵀ,

which is what generalised least squares do and leaves white noise of size 1.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from bo_sysid.diagnosis.windows.projection import project

_NOTHING = 1e-3  # of a direction: its share of the weighting, below which it is left out


def weighting(response: Float[np.ndarray, "W R k"]) -> Float[np.ndarray, "W R m"]:
    """Return Q such that I - QQᵀ = (I + A Aᵀ)^-½ for a response A."""
    U, S, _ = np.linalg.svd(response, full_matrices=False)
    share = 1.0 - 1.0 / np.sqrt(1.0 + S**2)
    most = int((share > _NOTHING).sum(axis=1).max(initial=0))
    return np.asarray((U * np.sqrt(share)[:, None, :])[..., :most])


@dataclass(frozen=True)
class ProcessNoise:
    """What noise of the inputs does to every window.

    Attributes:
        response: `W x R x k` A, in sigma of the sensors.
        basis: `W x R x m` Q such that I - QQᵀ = (I + A Aᵀ)^-½; nothing in it weights alike.
        controls: `W x S x nu` course n₀ about which A holds, added to the controls.
        drawn_response: `W x R` A ξ₀.
    """

    response: Float[np.ndarray, "W R k"]
    basis: Float[np.ndarray, "W R m"]
    controls: Float[np.ndarray, "W S nu"]
    drawn_response: Float[np.ndarray, "W R"]

    @classmethod
    def about(
        cls,
        response: Float[np.ndarray, "W R k"],
        controls: Float[np.ndarray, "W S nu"],
        drawn: Float[np.ndarray, "W k"],
    ) -> "ProcessNoise":
        """Return the noise with a response A about the course that `drawn` ξ₀ make."""
        drawn_response = np.einsum("wrk,wk->wr", response, drawn)
        return cls(response, weighting(response), controls, drawn_response)

    @property
    def unweighted(self) -> "ProcessNoise":
        """The same course, with which residuals are weighted by the sensors alone."""
        return replace(self, basis=self.basis[..., :0])

    def likely(self, left: Float[np.ndarray, "W R"]) -> Float[np.ndarray, "W k"]:
        """Return the expected ξ where A ξ and noise of the sensors are what is left.

        Aᵀ (I + A Aᵀ)⁻¹ = (I + AᵀA)⁻¹ Aᵀ.
        """
        A = self.response
        normal = np.eye(A.shape[2]) + A.transpose(0, 2, 1) @ A
        toward = np.einsum("wrk,wr->wk", A, left)
        return np.asarray(np.linalg.solve(normal, toward[..., None])[..., 0])

    def rows(self, keep: np.ndarray) -> "ProcessNoise":
        """Return that of some windows."""
        return replace(
            self,
            response=self.response[keep],
            basis=self.basis[keep],
            controls=self.controls[keep],
            drawn_response=self.drawn_response[keep],
        )

    def beginning(self, observations: int, steps: int) -> "ProcessNoise":
        """Return that of the first observations of every window, and of so many steps."""
        response = self.response[:, :observations]
        return ProcessNoise(
            response,
            weighting(response),
            self.controls[:, :steps],
            self.drawn_response[:, :observations],
        )

    def whiten(self, r: Float[np.ndarray, "W R *c"]) -> Float[np.ndarray, "W R *c"]:
        """Return residuals, or columns, weighted by (I + A Aᵀ)^-½."""
        return project(self.basis, r)
