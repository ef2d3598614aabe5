"""Max-value entropy search in its form for minima.

    α(β) = H[f(β)] − E[H[f(β) | f* ]],    f* = min_b f(b),    f = g(Δ)

With `γ = (μ(β) − f*)/σ(β)` this is the mean of `γ φ(γ) / (2 Φ(γ)) − log Φ(γ)` over samples of f*,
which come from joint posterior samples over B. (BoTorch's own class samples the extremum of a model
over its training inputs too, which are transformed ones in evaluation mode.)

References:
    Wang & Jegelka (2017), Max-value entropy search for efficient Bayesian optimization, equation 6.
"""

import numpy as np
from scipy.special import log_ndtr

from bo_sysid.acquisition.context import SelectionContext
from bo_sysid.acquisition.rows import RowAcquisition, Values, from_table
from bo_sysid.belief.argmin import argmin_posteriors

MINIMA = 64  # samples of f* of each member
_FAR = 6.0  # standard deviations above every minimum from which the decrease is below 1e-7 nats


def table(context: SelectionContext) -> Values:
    """Return the expected decrease of entropy of f(β), averaged over the ensemble, in nats."""
    surrogate = context.surrogate
    rng = context.generator()
    means, deviations = context.moments()
    values = np.zeros(len(context.candidates))
    posteriors = argmin_posteriors(surrogate, context.candidates, context.seed)
    for weight, mean, std, posterior in zip(
        surrogate.weights, means, deviations, posteriors, strict=True
    ):
        normals = rng.standard_normal((MINIMA, len(posterior.factor)))
        draws = posterior.mean + normals @ posterior.factor
        lowest = np.minimum(draws.min(axis=1, initial=np.inf), posterior.floor)
        minima = surrogate.shift + surrogate.scale * lowest
        near = np.flatnonzero(mean - _FAR * std < minima.max())
        for minimum in minima:
            values[near] += weight / MINIMA * entropy_decrease(mean[near], std[near], minimum)
    return values


def entropy_decrease(mean: Values, std: Values, minimum: float) -> Values:
    """Return `γ φ(γ) / (2 Φ(γ)) − log Φ(γ)`, zero where nothing is uncertain."""
    gamma = (mean - minimum) / np.where(std > 0, std, 1.0)
    log_density = -0.5 * gamma**2 - 0.5 * np.log(2 * np.pi)
    log_mass = log_ndtr(gamma)
    decrease = 0.5 * gamma * np.exp(log_density - log_mass) - log_mass
    return np.asarray(np.where(std > 0, decrease, 0.0))


def build(context: SelectionContext) -> RowAcquisition:
    """Return the acquisition for the surrogate of the context."""
    return from_table(context, table)
