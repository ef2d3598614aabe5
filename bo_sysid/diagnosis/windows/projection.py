"""What is taken out of the residuals of windows, each by itself."""

import numpy as np
from jaxtyping import Float


def project(
    Q: Float[np.ndarray, "W R k"], r: Float[np.ndarray, "W R *c"]
) -> Float[np.ndarray, "W R *c"]:
    """Return P r = r - Q Qᵀ r for each window."""
    if r.ndim == 2:
        return np.asarray(r - (Q @ (Q.transpose(0, 2, 1) @ r[..., None]))[..., 0])
    return np.asarray(r - Q @ (Q.transpose(0, 2, 1) @ r))
