"""P against exact integrals, brute force over the joint posterior, and its invariances."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import multivariate_normal, norm

from bo_sysid.belief import joint as joint_module
from bo_sysid.belief.argmin import ArgminBelief, argmin_probability, samples_per_member
from bo_sysid.belief.gp import ConditionedGP
from bo_sysid.belief.surrogate import Surrogate, fit_surrogate
from bo_sysid.belief.warp import Warp

UNIT = np.array([[0.0, 0.0], [1.0, 1.0]])
LOG = Warp(0.0, 1.0, 1e-9)
SAMPLES = 32_768
ERROR = 4 * 0.5 / np.sqrt(SAMPLES)  # four standard errors of a probability of one half


def one_member(points, values, lengthscale=0.5):
    """A surrogate with a single Gaussian process of given hyperparameters."""
    points, y = np.asarray(points, float), np.asarray(values, float)
    noise = np.full(len(y), 1e-6)
    plain = ConditionedGP("matern", np.full(2, lengthscale), 1.0, 0.1, points, np.eye(len(y)))
    chol = np.linalg.cholesky(plain.covariance(points, points) + np.diag(noise))
    member = ConditionedGP("matern", np.full(2, lengthscale), 1.0, 0.1, points, chol)
    return Surrogate(points, y, UNIT, noise, LOG, 0.0, 1.0, (member,), np.ones(1))


def joint(surrogate, x):
    """Posterior mean and covariance of the only member, by the textbook formula."""
    member = surrogate.members[0]
    K = member.covariance(surrogate.points, surrogate.points) + np.diag(surrogate.noise)
    k = member.covariance(surrogate.points, x)
    mean = member.mean + k.T @ np.linalg.solve(K, surrogate.values - member.mean)
    return mean, member.covariance(x, x) - k.T @ np.linalg.solve(K, k)


@pytest.fixture
def surrogate():
    return one_member([[0.2, 0.2], [0.9, 0.4], [0.5, 0.9]], [0.3, -0.2, 0.8])


def test_two_points_have_the_orthant_probability(surrogate):
    x = np.array([[0.3, 0.6], [0.7, 0.7]])
    mean, covariance = joint(surrogate, x)
    std = np.sqrt(covariance[0, 0] + covariance[1, 1] - 2 * covariance[0, 1])
    expected = norm.cdf((mean[1] - mean[0]) / std)
    belief = argmin_probability(surrogate, x, samples=SAMPLES)
    assert belief.probabilities[0] == pytest.approx(expected, abs=ERROR)
    assert belief.probabilities.sum() == pytest.approx(1.0)


def test_three_points_have_the_bivariate_orthant_probabilities(surrogate):
    x = np.array([[0.3, 0.6], [0.7, 0.7], [0.6, 0.1]])
    mean, covariance = joint(surrogate, x)
    expected = []
    for i in range(3):
        others = [j for j in range(3) if j != i]
        contrast = np.zeros((2, 3))
        contrast[:, i] = 1
        contrast[[0, 1], others] = -1
        difference = multivariate_normal(contrast @ mean, contrast @ covariance @ contrast.T)
        expected.append(difference.cdf(np.zeros(2)))
    belief = argmin_probability(surrogate, x, samples=SAMPLES)
    np.testing.assert_allclose(belief.probabilities, expected, atol=ERROR)


def test_an_evaluated_point_among_three_keeps_its_value(surrogate):
    """Two uncertain points against a known value, by quadrature over the first."""
    x = np.array([[0.3, 0.6], [0.7, 0.2], [0.9, 0.4]])
    mean, covariance = joint(surrogate, x)
    known = surrogate.values[1]
    s0, slope = np.sqrt(covariance[0, 0]), covariance[0, 1] / covariance[0, 0]
    s1 = np.sqrt(covariance[1, 1] - slope * covariance[0, 1])

    def above(v, level):
        return norm.sf((level - mean[1] - slope * (v - mean[0])) / s1)

    def density(v):
        return norm.pdf((v - mean[0]) / s0) / s0

    first = quad(lambda v: density(v) * above(v, v), mean[0] - 9 * s0, known)[0]
    third = quad(lambda v: density(v) * above(v, known), known, mean[0] + 9 * s0)[0]
    belief = argmin_probability(surrogate, x, samples=SAMPLES)
    np.testing.assert_allclose(belief.probabilities, [first, 1 - first - third, third], atol=ERROR)


def test_many_points_against_brute_force(surrogate):
    x = np.random.default_rng(0).random((150, 2))
    mean, covariance = joint(surrogate, x)
    rng = np.random.default_rng(1)
    draws = rng.multivariate_normal(mean, covariance, size=SAMPLES, method="eigh")
    expected = np.bincount(draws.argmin(axis=1), minlength=150) / SAMPLES
    belief = argmin_probability(surrogate, x, samples=SAMPLES)
    assert belief.estimator == "exact"
    assert belief.mass_lost <= 1e-3
    noise = np.sqrt(2 * expected / SAMPLES).sum() / 2  # of two independent histograms
    assert np.abs(belief.probabilities - expected).sum() / 2 < 1.5 * noise


def test_members_are_mixed_by_their_weights(surrogate):
    other = one_member(surrogate.points, surrogate.values, lengthscale=0.1)
    both = replace(
        surrogate, members=surrogate.members + other.members, weights=np.array([0.25, 0.75])
    )
    x = np.random.default_rng(0).random((20, 2))
    a, b, mixed = (
        argmin_probability(s, x, samples=SAMPLES).probabilities for s in (surrogate, other, both)
    )
    np.testing.assert_allclose(mixed, 0.25 * a + 0.75 * b, atol=2 * ERROR)
    assert samples_per_member(both.weights, 10).sum() == 10


def test_all_evaluated_is_certain():
    points = np.random.default_rng(0).random((8, 2))
    deviations = np.array([3.0, 1.0, 2.0, 0.5, 4.0, 0.9, 0.7, 0.5000001])
    belief = argmin_probability(fit_surrogate(points, deviations, UNIT, seed=0), points)
    assert belief.probabilities[3] == 1.0
    assert belief.entropy == 0.0
    assert belief.best == 3


@pytest.mark.parametrize("rounding", [0.0, 1e-15, -1e-15])
def test_equal_evaluated_minima_share(rounding):
    points = np.random.default_rng(0).random((4, 2))
    deviations = np.array([1.0, 0.5, 2.0, 0.5 + rounding])
    surrogate = fit_surrogate(points, deviations, UNIT, seed=0)
    belief = argmin_probability(surrogate, points)
    np.testing.assert_allclose(belief.probabilities, [0, 0.5, 0, 0.5])
    assert belief.entropy == pytest.approx(np.log(2))


def test_repeated_rows_share_the_probability_of_one(surrogate):
    x = np.random.default_rng(0).random((30, 2))
    once = argmin_probability(surrogate, x).probabilities
    twice = argmin_probability(surrogate, np.concatenate([x, x[:10]])).probabilities
    np.testing.assert_allclose(twice[:10], once[:10] / 2)
    np.testing.assert_allclose(twice[30:], once[:10] / 2)
    np.testing.assert_allclose(twice[10:30], once[10:])


def test_one_candidate_is_certain(surrogate):
    assert argmin_probability(surrogate, np.array([[0.3, 0.3]])).probabilities.tolist() == [1.0]


def test_evaluations_pin_their_candidates():
    points = np.array([[0.2, 0.2], [0.8, 0.8]])
    surrogate = fit_surrogate(points, np.array([1.0, 1.05]), UNIT, seed=0)
    assert argmin_probability(surrogate, points).probabilities.tolist() == [1.0, 0.0]


def test_constant_deviations_leave_the_belief_wide():
    x = np.random.default_rng(0).random((50, 2))
    belief = argmin_probability(fit_surrogate(x[:5], np.full(5, 0.3), UNIT, seed=0), x)
    assert belief.entropy > 2.0
    assert belief.probabilities[:5].max() < 0.2


def test_same_seed_same_belief(surrogate):
    x = np.random.default_rng(0).random((100, 2))
    a, b, c = (argmin_probability(surrogate, x, seed=s).probabilities for s in (1, 1, 2))
    assert a.tolist() == b.tolist()
    assert a.tolist() != c.tolist()


def test_order_of_candidates_does_not_matter(surrogate):
    x = np.random.default_rng(0).random((60, 2))
    order = np.random.default_rng(1).permutation(60)
    straight = argmin_probability(surrogate, x, samples=SAMPLES).probabilities
    shuffled = argmin_probability(surrogate, x[order], samples=SAMPLES).probabilities
    np.testing.assert_allclose(shuffled, straight[order], atol=2 * ERROR)


def test_entropy_of_a_uniform_belief():
    assert ArgminBelief(np.full(8, 1 / 8), "exact", 0.0).entropy == pytest.approx(np.log(8))


def test_low_rank_belief_over_many_candidates_is_near_the_exact_one(monkeypatch):
    """Two dimensions, 3 136 candidates: as near to an exact run as a second exact run is."""
    axes = np.meshgrid(np.linspace(0, 1, 56), np.linspace(0, 1, 56), indexing="ij")
    x = np.stack([a.ravel() for a in axes], axis=1)
    evaluated = np.random.default_rng(0).choice(len(x), 20, replace=False)
    u = x[evaluated] - np.array([0.43, 0.58])
    deviations = np.sqrt(0.02 + (u[:, 0] + u[:, 1]) ** 2 + 0.1 * u[:, 1] ** 2)
    surrogate = fit_surrogate(x[evaluated], deviations, UNIT, members=2, seed=0)
    monkeypatch.setattr(joint_module, "DENSE", 0)
    low_rank = argmin_probability(surrogate, x, samples=8192, seed=3)
    monkeypatch.setattr(joint_module, "EXACT", len(x))
    exact, again = (argmin_probability(surrogate, x, samples=8192, seed=s) for s in (1, 2))
    assert (low_rank.estimator, exact.estimator) == ("low-rank", "exact")
    assert low_rank.mass_lost <= 1e-3

    def distance(a, b):
        return np.abs(a.probabilities - b.probabilities).sum() / 2

    assert distance(low_rank, exact) < distance(again, exact) + 0.03
