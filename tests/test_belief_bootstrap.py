"""P_boot: resampling against its moments, limits with a known answer, coverage of the truth."""

import numpy as np
import pytest

from bo_sysid.belief.argmin import argmin_probability
from bo_sysid.belief.bootstrap import bootstrap_argmin, credible_interval, resample
from bo_sysid.belief.surrogate import fit_surrogate


def test_resampled_means_have_the_variance_of_the_mean():
    rng = np.random.default_rng(0)
    values = rng.normal(size=12)
    drawn = resample(np.zeros(12, dtype=int), 200_000, rng)
    means = drawn @ values / drawn.sum(axis=1)
    assert means.mean() == pytest.approx(values.mean(), abs=5e-3)
    assert means.var() == pytest.approx(values.var(ddof=1) / 12, rel=0.02)


def test_sessions_are_resampled_before_blocks():
    """Blocks that agree within three sessions: the spread is that between the sessions."""
    groups = np.repeat([7, 8, 9], [4, 10, 2])
    drawn = resample(groups, 100_000, np.random.default_rng(0))
    assert (drawn[:, :4].sum(axis=1) % 4 == 0).all()
    assert ((drawn[:, :4].sum(axis=1) > 0).astype(int).mean()) == pytest.approx(5 / 9, abs=0.01)
    per_session = np.array([drawn[:, groups == g].mean(axis=1) for g in (7, 8, 9)])
    means = per_session.T @ [1.0, 2.0, 6.0] / per_session.sum(axis=0)
    assert means.mean() == pytest.approx(3.0, abs=0.02)
    assert means.var() == pytest.approx(np.var([1.0, 2.0, 6.0], ddof=1) / 3, rel=0.02)


@pytest.mark.parametrize(("sessions", "blocks"), [(4, 10), (4, 2), (8, 5)])
@pytest.mark.parametrize("between", [0.0, 1.0])
def test_the_variance_over_sessions_is_as_stated(
    sessions: int, blocks: int, between: float
) -> None:
    """τ²/S + σ²/(S n) (1 + S/(S - 1) (n - 1)/n) with σ = 1, over many sets of recordings."""
    rng, groups = np.random.default_rng(0), np.repeat(np.arange(sessions), blocks)
    drawn = resample(groups, 400, rng)
    y = (
        rng.normal(size=(4_000, len(groups)))
        + between * rng.normal(size=(4_000, sessions))[:, groups]
    )
    found = (y @ drawn.T / drawn.sum(axis=1)).var(axis=1).mean()
    twice = 1 + sessions / (sessions - 1) * (blocks - 1) / blocks
    stated = between**2 / sessions + twice / (sessions * blocks)
    assert found == pytest.approx(stated, rel=0.05)


@pytest.mark.parametrize("cells", [1, 500])
def test_bootstraps_are_counted_in_parts_as_whole(monkeypatch, cells: int) -> None:
    """With every candidate evaluated nothing is drawn but bootstraps, and parts change nothing."""
    candidates, _, _, weights = location_problem(np.random.default_rng(2), 0.1)
    y = 0.1 + 0.3 * np.random.default_rng(2).normal(size=(len(weights), 6, 2))
    contributions = np.linalg.norm(y[None] - candidates[::4][:, :, None, None], axis=3).mean(axis=2)
    rows = np.arange(0, 161, 4)
    surrogate = surrogate_of(candidates, rows, contributions, weights)
    given = (surrogate, candidates[rows], np.arange(len(rows)), contributions, weights)
    whole = bootstrap_argmin(*given, samples=500)
    monkeypatch.setattr("bo_sysid.belief.bootstrap.CELLS", cells)
    np.testing.assert_array_equal(
        bootstrap_argmin(*given, samples=500).probabilities, whole.probabilities
    )


def location_problem(rng, truth, blocks=40, length=6, noise=0.3):
    """y = truth + noise in two channels; Δ(β) = mean ‖y − β‖₂ on a grid of 161 β in 1 d."""
    candidates = np.linspace(-1, 1, 161)[:, None]
    y = truth + noise * rng.normal(size=(blocks, length, 2))
    rows = np.round(np.linspace(0, 160, 17)).astype(int)
    rows = np.unique(np.append(rows, np.arange(60, 101, 4)))
    residual = y[None] - candidates[rows][:, :, None, None]
    contributions = np.linalg.norm(residual, axis=3).mean(axis=2)
    return candidates, rows, contributions, np.full(blocks, float(length))


BOUNDS = np.array([[-1.0], [1.0]])


def surrogate_of(candidates, rows, contributions, weights):
    deviations = contributions @ weights / weights.sum()
    return fit_surrogate(candidates[rows], deviations, BOUNDS, members=4, seed=0)


def test_recordings_without_variation_give_the_belief():
    """Where all blocks are equal every bootstrap is the same Δ."""
    problem = location_problem(np.random.default_rng(0), 0.1)
    candidates, rows, contributions, weights = problem
    equal = np.repeat(contributions.mean(axis=1, keepdims=True), len(weights), axis=1)
    surrogate = surrogate_of(candidates, rows, equal, weights)
    belief = argmin_probability(surrogate, candidates, samples=8192)
    found = bootstrap_argmin(surrogate, candidates, rows, equal, weights, samples=8192)
    assert np.abs(found.probabilities - belief.probabilities).sum() / 2 < 0.06


def test_spread_is_that_of_the_estimator():
    """With B finely evaluated P_boot is the bootstrap of the exact arg-min."""
    candidates, _, _, weights = location_problem(np.random.default_rng(1), 0.1)
    y = 0.1 + 0.3 * np.random.default_rng(1).normal(size=(len(weights), 6, 2))
    rows = np.arange(0, 161, 2)
    residual = y[None] - candidates[rows][:, :, None, None]
    contributions = np.linalg.norm(residual, axis=3).mean(axis=2)
    surrogate = surrogate_of(candidates, rows, contributions, weights)
    found = bootstrap_argmin(
        surrogate, candidates[rows], np.arange(len(rows)), contributions, weights, samples=20_000
    )
    drawn = resample(np.zeros(len(weights), dtype=int), 20_000, np.random.default_rng(9))
    exact = (contributions @ drawn.T).argmin(axis=0)
    expected = np.bincount(exact, minlength=len(rows)) / 20_000
    assert np.abs(found.probabilities - expected).sum() / 2 < 0.02
    assert found.mass_lost <= 1e-3


def test_interval_covers_the_truth_at_its_rate():
    """Linear-Gaussian recordings: of 300 intervals of 90 % between 85 and 95 % hold the truth.

    The hyperparameters are those of the first case; P_boot takes nothing else from the surrogate.
    """
    rng = np.random.default_rng(0)
    surrogate = surrogate_of(*location_problem(rng, 0.0))
    covered = 0
    for _ in range(300):
        truth = rng.uniform(-0.2, 0.2)
        candidates, rows, contributions, weights = location_problem(rng, truth)
        belief = bootstrap_argmin(surrogate, candidates, rows, contributions, weights, samples=400)
        low, high = credible_interval(candidates, belief.probabilities, 0.9)[:, 0]
        half = 0.5 * (candidates[1, 0] - candidates[0, 0])
        covered += low - half <= truth <= high + half
    assert 0.85 <= covered / 300 <= 0.95


def test_belief_narrows_where_bootstrap_does_not():
    """P goes to a point as Δ is evaluated; P_boot stays as wide as the recordings leave it."""
    rng = np.random.default_rng(3)
    y = 0.3 * rng.normal(size=(40, 6, 2))
    candidates = np.linspace(-1, 1, 161)[:, None]
    rows = np.arange(161)
    contributions = np.linalg.norm(y[None] - candidates[:, :, None, None], axis=3).mean(axis=2)
    weights = np.full(40, 6.0)
    surrogate = surrogate_of(candidates, rows[::2], contributions[::2], weights)
    belief = argmin_probability(surrogate, candidates)
    boot = bootstrap_argmin(surrogate, candidates, rows[::2], contributions[::2], weights)
    width = np.diff(credible_interval(candidates, boot.probabilities)[:, 0])[0]
    assert np.diff(credible_interval(candidates, belief.probabilities)[:, 0])[0] < 0.3 * width


def test_a_faint_minimum_is_where_bootstraps_of_every_candidate_have_it():
    """Δ varies by 2 % of a floor that noise makes; which blocks are drawn moves it by more."""
    rng = np.random.default_rng(0)
    candidates = np.linspace(-1, 1, 101)[:, None]
    blocks = 40
    level = 1 + 0.05 * rng.normal(size=blocks)
    centre = 0.1 + 0.2 * rng.normal(size=blocks)
    everywhere = level + 0.02 * (candidates - centre) ** 2
    weights = np.ones(blocks)
    drawn = resample(np.zeros(blocks, dtype=int), 20_000, rng)
    winners = (everywhere @ drawn.T).argmin(axis=0)
    truth = np.bincount(winners, minlength=101) / len(drawn)
    rows = np.arange(0, 101, 10)
    surrogate = surrogate_of(candidates, rows, everywhere[rows], weights)
    found = bootstrap_argmin(surrogate, candidates, rows, everywhere[rows], weights, samples=8192)
    assert 0.5 * np.abs(found.probabilities - truth).sum() < 0.08
    low, high = credible_interval(candidates, found.probabilities)[:, 0]
    wanted = credible_interval(candidates, truth)[:, 0]
    assert (low, high) == pytest.approx(tuple(wanted), abs=0.021)


@pytest.mark.parametrize("rounding", [0.0, 1e-15])
def test_candidates_that_no_recording_tells_apart_share_what_they_win(rounding):
    """A parameter without any effect: every bootstrap has ties, all of B was evaluated.

    Of a gain and an inertia, which tell a ratio alone, they are ties up to rounding.
    """
    truth = np.linspace(-1, 1, 5)
    candidates = np.array([[a, b] for a in truth for b in (-1.0, 0.0, 1.0)])
    rows = np.random.default_rng(0).permutation(len(candidates))
    blocks = 0.2 * np.random.default_rng(1).normal(size=20)
    contributions = 0.1 + np.abs(candidates[rows][:, [0]] - blocks)
    contributions *= 1 + rounding * candidates[rows][:, [1]]
    weights = np.ones(20)
    bounds = np.array([[-1.0, -1.0], [1.0, 1.0]])
    deviations = contributions.mean(axis=1)
    surrogate = fit_surrogate(candidates[rows], deviations, bounds, members=2, seed=0)
    found = bootstrap_argmin(surrogate, candidates, rows, contributions, weights)
    shares = found.probabilities.reshape(5, 3).sum(axis=0)
    np.testing.assert_allclose(shares, 1 / 3, atol=0.04)
    low, high = credible_interval(candidates, found.probabilities)
    assert (low[1], high[1]) == (-1.0, 1.0)


def test_sessions_that_differ_widen_the_interval():
    rng = np.random.default_rng(5)
    candidates = np.linspace(-1, 1, 161)[:, None]
    rows = np.arange(0, 161, 5)
    centre = np.repeat([-0.2, 0.0, 0.2], 10)[:, None, None]
    y = centre + 0.1 * rng.normal(size=(30, 6, 2))
    contributions = np.linalg.norm(y[None] - candidates[rows][:, :, None, None], axis=3).mean(2)
    weights = np.full(30, 6.0)
    surrogate = surrogate_of(candidates, rows, contributions, weights)
    widths = []
    for groups in (None, np.repeat([0, 1, 2], 10)):
        belief = bootstrap_argmin(
            surrogate, candidates, rows, contributions, weights, groups=groups
        )
        widths.append(np.diff(credible_interval(candidates, belief.probabilities)[:, 0])[0])
    assert widths[1] > 1.5 * widths[0]


def test_points_outside_the_set_count_but_cannot_win():
    candidates, rows, contributions, weights = location_problem(np.random.default_rng(0), 0.0)
    surrogate = surrogate_of(candidates, rows, contributions, weights)
    zoomed = np.linspace(-0.1, 0.1, 81)[:, None]
    belief = bootstrap_argmin(
        surrogate, zoomed, np.full(len(rows), -1), contributions, weights, samples=2000
    )
    whole = bootstrap_argmin(surrogate, candidates, rows, contributions, weights, samples=2000)
    a = zoomed[:, 0] @ belief.probabilities
    assert a == pytest.approx(candidates[:, 0] @ whole.probabilities, abs=0.01)


def test_inputs_that_do_not_fit():
    candidates, rows, contributions, weights = location_problem(np.random.default_rng(0), 0.0)
    surrogate = surrogate_of(candidates, rows, contributions, weights)
    with pytest.raises(ValueError, match="one block cannot be resampled"):
        bootstrap_argmin(surrogate, candidates, rows, contributions[:, :1], weights[:1])
    with pytest.raises(ValueError, match="rows must be those of the surrogate's points"):
        bootstrap_argmin(surrogate, candidates, rows[::-1].copy(), contributions, weights)
    with pytest.raises(ValueError, match="evaluated points need"):
        bootstrap_argmin(surrogate, candidates, rows[:-1], contributions[:-1], weights)


def test_credible_interval_by_hand():
    points = np.array([[0.0, 5.0], [1.0, 4.0], [2.0, 3.0], [3.0, 2.0]])
    P = np.array([0.05, 0.45, 0.45, 0.05])
    assert credible_interval(points, P, 0.9).tolist() == [[0.0, 2.0], [2.0, 4.0]]
    assert credible_interval(points, P, 0.8).tolist() == [[1.0, 3.0], [2.0, 4.0]]
    assert credible_interval(points, np.array([0, 0, 1.0, 0]), 0.95).tolist() == [[2, 3], [2, 3]]
    with pytest.raises(ValueError, match="between 0 and 1"):
        credible_interval(points, P, 95.0)
