"""The surrogate against the textbook formulas written out independently, and BoTorch's model."""

import numpy as np
import pytest
import torch
from scipy.optimize import approx_fprime
from scipy.stats import multivariate_normal
from threadpoolctl import threadpool_info, threadpool_limits

from bo_sysid.belief import hyperparameters
from bo_sysid.belief.gp import MEAN_VARIANCE, MarginalLikelihood
from bo_sysid.belief.surrogate import KERNELS, POWERS, default_prior, fit_surrogate
from bo_sysid.belief.warp import ZERO, Warp

BOUNDS = np.array([[1.0, -2.0], [3.0, 2.0]])


def deviations_at(points):
    """A valley with a floor, in the units of BOUNDS."""
    u = (points - np.array([1.8, 0.3])) / np.array([2.0, 4.0])
    return np.sqrt(0.01 + (u[:, 0] + u[:, 1]) ** 2 + 0.1 * u[:, 1] ** 2)


@pytest.fixture
def points():
    return BOUNDS[0] + np.random.default_rng(3).random((14, 2)) * (BOUNDS[1] - BOUNDS[0])


def correlation_matrix(kernel, a, b, lengthscales):
    """Loops over pairs, straight from Rasmussen & Williams 4.9 and 4.17."""
    out = np.empty((len(a), len(b)))
    for i, p in enumerate(a):
        for j, q in enumerate(b):
            r = np.sqrt((((p - q) / lengthscales) ** 2).sum())
            out[i, j] = (
                np.exp(-(r**2) / 2)
                if kernel == "rbf"
                else (1 + np.sqrt(5) * r + 5 * r**2 / 3) * np.exp(-np.sqrt(5) * r)
            )
    return out


@pytest.mark.parametrize("kernel", KERNELS)
def test_evidence_is_the_density_of_the_values(kernel):
    rng = np.random.default_rng(0)
    x, y, noise = rng.random((7, 2)), rng.normal(size=7), np.full(7, 1e-2)
    theta = np.log([0.4, 0.9, 1.7])
    squared = (x.T[:, :, None] - x.T[:, None, :]) ** 2
    evidence = MarginalLikelihood(kernel, squared, y, noise)
    covariance = 1.7 * correlation_matrix(kernel, x, x, np.array([0.4, 0.9]))
    covariance += np.diag(noise) + MEAN_VARIANCE
    value, gradient = evidence(np.stack([theta, theta + 0.3]))
    assert value[0] == pytest.approx(multivariate_normal(np.zeros(7), covariance).logpdf(y))
    numeric = approx_fprime(theta, lambda t: evidence(t[None])[0][0], 1e-6)
    np.testing.assert_allclose(gradient[0], numeric, rtol=1e-4, atol=1e-4)


def test_posterior_is_the_mixture_of_the_textbook_formula(points):
    surrogate = fit_surrogate(points, deviations_at(points), BOUNDS, powers=(0.0,), seed=0)
    query = BOUNDS[0] + np.random.default_rng(4).random((5, 2)) * (BOUNDS[1] - BOUNDS[0])
    x, q = ((p - BOUNDS[0]) / (BOUNDS[1] - BOUNDS[0]) for p in (points, query))
    y = np.log(deviations_at(points))
    y = y - y.mean()  # Δ is measured in units of its geometric mean
    z = (y - y.mean()) / y.std(ddof=1)
    means, seconds = [], []
    for member in surrogate.members:
        args = (member.lengthscales,)
        K = member.outputscale * correlation_matrix(member.kernel, x, x, *args)
        K += np.diag(surrogate.noise)
        k = member.outputscale * correlation_matrix(member.kernel, x, q, *args)
        mean = member.mean + k.T @ np.linalg.solve(K, z - member.mean)
        variance = member.outputscale - np.diag(k.T @ np.linalg.solve(K, k))
        means.append(mean)
        seconds.append(variance + mean**2)
    mean = surrogate.weights @ np.array(means)
    variance = surrogate.weights @ np.array(seconds) - mean**2
    found_mean, found_variance = surrogate.moments(query)
    np.testing.assert_allclose(found_mean, y.std(ddof=1) * mean, rtol=1e-6)
    np.testing.assert_allclose(found_variance, y.var(ddof=1) * variance, rtol=1e-5)


def test_models_are_single_task_gps_with_the_same_posterior(points):
    surrogate = fit_surrogate(points, deviations_at(points), BOUNDS, members=4, seed=0)
    query = BOUNDS[0] + np.random.default_rng(4).random((6, 2)) * (BOUNDS[1] - BOUNDS[0])
    means, variances = [], []
    for model in surrogate.models():
        posterior = model.posterior(torch.tensor(query))
        assert posterior.mean.dtype == torch.float64
        means.append(posterior.mean.detach().numpy()[:, 0])
        variances.append(posterior.variance.detach().numpy()[:, 0])
    mean = surrogate.weights @ np.array(means)
    spread = surrogate.weights @ (np.array(variances) + (np.array(means) - mean) ** 2)
    found_mean, found_variance = surrogate.moments(query)
    np.testing.assert_allclose(found_mean, mean, rtol=1e-6)
    np.testing.assert_allclose(found_variance, spread, rtol=1e-4)


def test_hyperparameters_are_averaged_over_their_posterior():
    """Members must have the moments of p(θ | y), computed here on a fine grid of θ."""
    rng = np.random.default_rng(1)
    x = rng.random((9, 1))
    deviations = np.exp(np.sin(5 * x[:, 0]))
    surrogate = fit_surrogate(
        x, deviations, np.array([[0.0], [1.0]]), members=2000, powers=(0.0,), seed=0
    )
    theta = np.array([np.log([m.lengthscales[0], m.outputscale]) for m in surrogate.members])
    found = surrogate.weights @ theta
    found_rbf = surrogate.weights @ np.array([m.kernel == "rbf" for m in surrogate.members])
    y = np.log(deviations)
    z = (y - y.mean()) / y.std(ddof=1)
    axes = np.meshgrid(np.linspace(-3.5, 2.5, 121), np.linspace(-4, 6, 101), indexing="ij")
    grid = np.stack([a.ravel() for a in axes], axis=1)
    prior = default_prior(1)(grid)[0]
    densities = [
        MarginalLikelihood(k, ((x.T[:, :, None] - x.T[:, None]) ** 2), z, surrogate.noise)(grid)[0]
        + prior
        for k in KERNELS
    ]
    top = max(d.max() for d in densities)
    mass = [np.exp(d - top) for d in densities]
    total = sum(m.sum() for m in mass)
    expected = sum(m @ grid for m in mass) / total
    np.testing.assert_allclose(found, expected, atol=0.08)
    assert found_rbf == pytest.approx(mass[KERNELS.index("rbf")].sum() / total, abs=0.06)


def test_values_at_evaluated_points_are_kept(points):
    deviations = deviations_at(points)
    surrogate = fit_surrogate(points, deviations, BOUNDS, seed=0)
    mean, variance = surrogate.moments(points)
    np.testing.assert_allclose(mean, surrogate.warp(deviations), atol=3e-3)
    assert np.sqrt(variance).max() < 3e-3


def test_hyperparameters_are_searched_by_one_blas_thread(points, monkeypatch):
    """Matrices of a few dozen rows gain nothing by more, and threads that wait spin."""
    seen, climb = [], hyperparameters._climb

    def watched(*given):
        seen.append({p["num_threads"] for p in threadpool_info() if p["user_api"] == "blas"})
        return climb(*given)

    monkeypatch.setattr(hyperparameters, "_climb", watched)
    with threadpool_limits(2):
        fit_surrogate(points, deviations_at(points), bounds=BOUNDS)
    assert seen
    assert all(numbers == {1} for numbers in seen)


def test_same_seed_same_ensemble(points):
    a, b = (fit_surrogate(points, deviations_at(points), BOUNDS, seed=5) for _ in range(2))
    assert a.weights.tolist() == b.weights.tolist()
    assert [m.mean for m in a.members] == [m.mean for m in b.members]


@pytest.mark.parametrize("size", [1, 2])
def test_few_points(points, size):
    surrogate = fit_surrogate(points[:size], deviations_at(points)[:size], BOUNDS, seed=0)
    mean, variance = surrogate.moments(points)
    assert np.isfinite(mean).all()
    assert (variance >= 0).all()


def test_constant_deviations_and_repeated_points():
    points = np.repeat([[1.5, 0.0], [2.5, 1.0], [2.0, -1.0]], 2, axis=0)
    surrogate = fit_surrogate(points, np.full(6, 0.3), BOUNDS, seed=0)
    mean, _ = surrogate.moments(points)
    np.testing.assert_allclose(mean, 0.0, atol=1e-2)


def test_huge_range_of_deviations(points):
    deviations = np.geomspace(1e-9, 1e6, len(points))
    surrogate = fit_surrogate(points, deviations, BOUNDS, seed=0)
    mean, variance = surrogate.moments(points)
    assert surrogate.warp.power == 0
    np.testing.assert_allclose(mean, surrogate.warp(deviations), atol=0.1)
    assert np.isfinite(variance).all()


@pytest.mark.parametrize("power", POWERS)
def test_warp_is_increasing_and_takes_the_same_volume(power):
    """With Δ in units of its geometric mean the product of the derivatives is 1."""
    deviations = np.array([0.02, 0.5, 0.7, 3.0, 11.0])
    warp = Warp.of(deviations, power)
    step = 1e-6
    slopes = (warp(deviations * (1 + step)) - warp(deviations * (1 - step))) / (2 * step)
    np.testing.assert_allclose(slopes, (deviations / warp.unit) ** power, rtol=1e-6)
    assert np.prod(slopes / (deviations / warp.unit)) == pytest.approx(1.0)
    assert (np.diff(warp(deviations)) > 0).all()


def test_power_is_the_one_that_makes_the_values_smooth(points):
    """A smooth function is given as Δ, as its square and as its exponential."""
    u = (points - BOUNDS[0]) / (BOUNDS[1] - BOUNDS[0])
    smooth = 2.0 + np.sin(4 * u[:, 0]) + np.cos(3 * u[:, 1])
    for deviations, power in ((smooth, 1.0), (smooth**2, 0.5), (np.exp(2 * smooth), 0.0)):
        assert fit_surrogate(points, deviations, BOUNDS, seed=0).warp.power == power


def test_zero_deviation_has_a_logarithm():
    warp = Warp.of(np.array([0.0, 0.5, 2.0]), 0.0)
    found = np.exp(warp(np.array([0.0, 0.5, 2.0]))) * warp.unit
    np.testing.assert_allclose(found, [0.5 * ZERO, 0.5, 2.0])
    assert Warp.of(np.zeros(2), 0.0)(np.zeros(2)).tolist() == [0.0, 0.0]


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1.0])
def test_deviations_that_are_not_numbers(points, bad):
    deviations = deviations_at(points)
    deviations[3] = bad
    with pytest.raises(ValueError, match="evaluation 3 is not a finite number"):
        fit_surrogate(points, deviations, BOUNDS, seed=0)


def test_inputs_that_do_not_fit(points):
    good = deviations_at(points)
    with pytest.raises(ValueError, match="do not belong to points"):
        fit_surrogate(points, good[:-1], BOUNDS, seed=0)
    with pytest.raises(ValueError, match="lower row below an upper row"):
        fit_surrogate(points, good, BOUNDS[::-1], seed=0)
    points[2, 1] = np.nan
    with pytest.raises(ValueError, match="must be finite"):
        fit_surrogate(points, good, BOUNDS, seed=0)
