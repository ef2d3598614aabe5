"""Each rule against its definition, computed by quadrature, brute force or a textbook formula."""

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.stats import multivariate_normal, norm, truncnorm

from bo_sysid.acquisition import SelectionContext, build_acquisition
from bo_sysid.acquisition.entropy_reduction import table as entropy_reduction
from bo_sysid.acquisition.knowledge_gradient import table as knowledge_gradient
from bo_sysid.acquisition.max_value_entropy import entropy_decrease
from bo_sysid.acquisition.thompson import table as thompson
from bo_sysid.belief.argmin import ArgminBelief, argmin_probability
from bo_sysid.belief.surrogate import fit_surrogate

UNIT = np.array([[0.0, 0.0], [1.0, 1.0]])


def make_context(candidates, evaluated, members=1, seed=0):
    """Evaluated candidates have the Δ of a valley."""
    points = np.asarray(candidates, dtype=float)
    deviations = np.sqrt(0.05 + ((points[evaluated] - 0.4) ** 2).sum(axis=1))
    surrogate = fit_surrogate(points[evaluated], deviations, UNIT, members=members, seed=0)
    belief = argmin_probability(surrogate, points, seed=seed, samples=16_384)
    return SelectionContext(surrogate, belief, points, np.asarray(evaluated), seed)


def joint(context, rows, member=0):
    """Posterior mean and covariance of log Δ by the textbook formula."""
    surrogate = context.surrogate
    process = surrogate.members[member]
    x, new = surrogate.unit(surrogate.points), surrogate.unit(context.candidates[rows])
    K = process.covariance(x, x) + np.diag(surrogate.noise)
    k = process.covariance(x, new)
    y = surrogate.standardised
    mean = process.mean + k.T @ np.linalg.solve(K, y - process.mean)
    covariance = process.covariance(new, new) - k.T @ np.linalg.solve(K, k)
    return surrogate.shift + surrogate.scale * mean, surrogate.scale**2 * covariance


@pytest.fixture(scope="module")
def scattered():
    """Twenty candidates, seven of them evaluated, four members."""
    points = np.random.default_rng(1).random((20, 2))
    return make_context(points, np.arange(7), members=4)


def values_of(name, context):
    with torch.no_grad():
        return build_acquisition(name, context)(context.choices.unsqueeze(-2)).numpy()


def test_log_expected_improvement_is_the_textbook_mixture(scattered):
    rows = np.arange(7, 20)
    best = scattered.surrogate.values.min()
    expected = np.zeros(len(rows))
    for m, weight in enumerate(scattered.surrogate.weights):
        mean, covariance = joint(scattered, rows, m)
        std = np.sqrt(np.diag(covariance))
        u = (best - mean) / std
        expected += weight * std * (u * norm.cdf(u) + norm.pdf(u))
    found = values_of("log-expected-improvement", scattered)[rows]
    np.testing.assert_allclose(np.exp(found), expected, rtol=1e-3, atol=1e-8)


def test_log_expected_improvement_with_a_pending_point_is_that_of_both(scattered):
    """It is never less than that of the pending point alone, and more where another adds to it."""
    acquisition = build_acquisition("log-expected-improvement", scattered)
    choices = scattered.choices[7:]
    with torch.no_grad():
        alone = acquisition(choices.unsqueeze(-2))
        best = int(alone.argmax())
        acquisition.set_X_pending(choices[[best]])
        both = acquisition(choices[np.delete(np.arange(13), best)].unsqueeze(-2))
        acquisition.set_X_pending(None)
        torch.testing.assert_close(acquisition(choices.unsqueeze(-2)), alone)
    assert both.min() > alone[best] - 0.1
    assert both.max() > alone[best] + 0.1


def test_thompson_chooses_candidates_as_often_as_they_are_the_arg_min():
    points = np.random.default_rng(2).random((6, 2))
    context = make_context(points, [0, 1], members=3)
    picks = np.zeros(6)
    for seed in range(400):
        state = SelectionContext(
            context.surrogate, context.belief, context.candidates, context.evaluated, seed
        )
        picks[thompson(state).argmax()] += 1 / 400
    np.testing.assert_allclose(picks, context.belief.probabilities, atol=4 * 0.5 / np.sqrt(400))


@pytest.mark.parametrize("minimum", [-3.0, -0.5, 0.4])
def test_max_value_entropy_is_the_fall_of_the_entropy_of_a_truncated_normal(minimum):
    mean, std = 0.2, 0.7
    before = norm(mean, std).entropy()
    after = truncnorm((minimum - mean) / std, 40.0, mean, std).entropy()
    found = entropy_decrease(np.array([mean, 1.0]), np.array([std, 0.0]), minimum)
    assert found[0] == pytest.approx(before - after, rel=1e-6, abs=1e-9)
    assert found[1] == 0.0


def test_knowledge_gradient_is_the_expected_fall_of_the_least_mean():
    points = np.random.default_rng(3).random((9, 2))
    context = make_context(points, [0, 1, 2])
    rows = np.arange(3, 9)
    mean, covariance = joint(context, rows)
    known = context.surrogate.values.min()
    z = norm.ppf((np.arange(4000) + 0.5) / 4000)
    for i, row in enumerate(rows):
        moved = mean + z[:, None] * covariance[:, i] / np.sqrt(covariance[i, i])
        after = np.minimum(moved.min(axis=1), known).mean()
        expected = min(mean.min(), known) - after
        assert knowledge_gradient(context)[row] == pytest.approx(expected, rel=0.05, abs=2e-3)


def test_entropy_reduction_on_two_candidates_by_quadrature():
    """After one of two is known the other is below it with a normal probability."""
    points = np.array([[0.1, 0.9], [0.35, 0.4], [0.7, 0.5]])
    deviations = np.array([1.0])
    surrogate = fit_surrogate(points[:1], deviations, UNIT, members=1, seed=0)
    pair = points[1:]
    belief = argmin_probability(surrogate, pair, samples=16_384)
    context = SelectionContext(surrogate, belief, pair, np.array([], dtype=int), 0)
    mean, covariance = joint(context, [0, 1])

    def entropy(p):
        p = np.clip(p, 1e-300, 1)
        return -p * np.log(p) - (1 - p) * np.log1p(-min(p, 1 - 1e-16))

    gap = np.sqrt(covariance[0, 0] + covariance[1, 1] - 2 * covariance[0, 1])
    now = entropy(norm.cdf((mean[1] - mean[0]) / gap))
    for i, j in ((0, 1), (1, 0)):
        std = np.sqrt(covariance[i, i])
        slope = covariance[i, j] / covariance[i, i]
        rest = np.sqrt(covariance[j, j] - slope * covariance[i, j])

        def term(y, i=i, j=j, std=std, slope=slope, rest=rest):
            other = norm.cdf((y - mean[j] - slope * (y - mean[i])) / rest)
            return norm.pdf((y - mean[i]) / std) / std * entropy(other)

        after = quad(term, mean[i] - 8 * std, mean[i] + 8 * std)[0]
        assert entropy_reduction(context)[i] == pytest.approx(now - after, abs=0.04)


def test_entropy_reduction_of_what_is_known_is_nothing(scattered):
    values = values_of("entropy-reduction", scattered)
    np.testing.assert_allclose(values[scattered.evaluated], 0, atol=1e-2)
    assert values.max() > 0.05


def test_entropy_reduction_prefers_no_candidate_of_probability_zero():
    """Where what is evaluated leaves nothing to learn, all that could be is worth 0 or less."""
    points = np.random.default_rng(1).random((20, 2))
    far = np.argsort(((points - 0.4) ** 2).sum(axis=1))[-4:]
    context = make_context(points, np.setdiff1d(np.arange(20), far))
    P = np.zeros(20)
    P[far[-2:]] = 0.5
    belief = ArgminBelief(P, "exact", 0.0)
    values = entropy_reduction(
        SelectionContext(context.surrogate, belief, points, context.evaluated, 0)
    )
    assert values[far].max() <= 0
    assert values[far[-2:]].min() > np.delete(values, far[-2:]).max()


def test_a_pending_evaluation_lowers_the_expected_entropy(scattered):
    """The sum of the contributions is the entropy, which an evaluation lowers on average."""
    acquisition = build_acquisition("argmin-entropy", scattered)
    free = scattered.choices[7:]
    with torch.no_grad():
        before = acquisition(free.unsqueeze(-2))
        best = int(before.argmax())
        acquisition.set_X_pending(free[[best]])
        after = acquisition(free.unsqueeze(-2))
    others = np.delete(np.arange(len(free)), best)
    assert after[best] == -torch.inf
    assert after[others].sum() < before[others].sum()


def test_conditioned_surrogate_is_the_one_given_all_values(scattered):
    """The members of the grown surrogate are the processes conditioned on all points at once."""
    surrogate = scattered.surrogate
    rows = [8, 11]
    y = surrogate.moments(scattered.candidates[rows])[0] + 0.01
    grown = surrogate.conditioned(scattered.candidates[rows], y)
    mean, covariance = joint(scattered, [8, 11, 15])
    gain = covariance[2, :2] @ np.linalg.inv(covariance[:2, :2] + 1e-9 * np.eye(2))
    expected = mean[2] + gain @ (y - mean[:2])
    state = SelectionContext(grown, scattered.belief, scattered.candidates, scattered.evaluated)
    means, deviations = state.moments()
    assert means[0, 15] == pytest.approx(expected, rel=1e-3)
    variance = covariance[2, 2] - gain @ covariance[:2, 2]
    assert deviations[0, 15] == pytest.approx(np.sqrt(variance), rel=1e-3)
    assert means[0, 8] == pytest.approx(y[0])
    evidence = []
    for m in range(len(surrogate.members)):
        mean, covariance = joint(scattered, rows, m)
        covariance += surrogate.scale**2 * surrogate.noise[0] * np.eye(2)
        evidence.append(multivariate_normal(mean, covariance).pdf(y))
    weights = surrogate.weights * evidence
    np.testing.assert_allclose(grown.weights, weights / weights.sum(), rtol=1e-2)


def test_models_of_a_conditioned_surrogate_follow_it(scattered):
    grown = scattered.surrogate.conditioned(scattered.candidates[[9]], np.array([-0.3]))
    posterior = grown.models()[0].posterior(scattered.choices[10:14])
    state = SelectionContext(grown, scattered.belief, scattered.candidates, scattered.evaluated)
    np.testing.assert_allclose(
        posterior.mean.detach().numpy()[:, 0], state.moments()[0][0, 10:14], rtol=1e-5
    )


def test_context_after_pending_rows(scattered):
    later = scattered.after(np.array([9, 12]), seed=0)
    assert later.evaluated.tolist() == [*range(7), 9, 12]
    np.testing.assert_array_equal(later.surrogate.points[-2:], scattered.candidates[[9, 12]])
    draws = [scattered.after(np.array([9]), seed=s).surrogate.values[-1] for s in range(9)]
    assert np.std(draws) > 0
    mean, std = scattered.moments()
    low = (mean - 4 * std).min(axis=0)[9]
    high = (mean + 4 * std).max(axis=0)[9]
    assert all(low < d < high for d in draws)
