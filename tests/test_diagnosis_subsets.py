"""Set scores against least squares on the columns themselves."""

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from bo_sysid.diagnosis.sets.subsets import Unit, clashes, gram, groups, search
from bo_sysid.diagnosis.windows.candidate import Candidate
from bo_sysid.effects import Component, Effect, Extent, Site


def fake(effect: str, site: str, low: float = -1e6, high: float = 1e6, **fields) -> Candidate:
    """A candidate with one magnitude."""
    extent = Extent((1.0,), (low,), (high,))
    made = Effect(
        id=effect, kind="joint", components=(Component("size", ""),), apply=lambda *_: None,
        extent=lambda *_: extent, noun="", sentence="", evidence="", separation="", **fields,
    )  # fmt: skip
    return Candidate(made, Site("joint", site), extent, np.ones(1))


@pytest.fixture
def problem():
    rng = np.random.default_rng(0)
    S = rng.normal(size=(400, 9))
    S[:, 4] = (
        0.7 * S[:, 0] + 0.7 * S[:, 1] + 0.05 * rng.normal(size=400)
    )  # a decoy for greedy search
    y = 3 * S[:, 0] + 3 * S[:, 1] + 2 * S[:, 8] + 0.1 * rng.normal(size=400)
    held = [fake(f"e{k}", "a") for k in range(8)]
    owner = np.array([0, 1, 2, 3, 4, 5, 6, 7, -1])  # the last column is a nuisance
    return held, S, y, owner


def test_gain_equals_the_drop_of_least_squares(problem) -> None:
    held, S, y, owner = problem
    table = gram(held, S.T @ S, S.T @ y, owner, {})
    (scored,) = table.score([(Unit((0,)), Unit((3,)))])
    without = np.linalg.lstsq(S[:, [8]], y, rcond=None)[1][0]
    with_both, rss = np.linalg.lstsq(S[:, [0, 3, 8]], y, rcond=None)[:2]
    assert scored.gain == pytest.approx(without - rss[0], rel=1e-4)
    np.testing.assert_allclose(scored.x, with_both[:2], rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("unit", [1e-4, 1.0, 1e7])
def test_a_nuisance_is_left_out_whatever_the_unit_of_another(problem, unit) -> None:
    """The eighth candidate does what one nuisance does; the other has a large or a small unit."""
    held, S, y, _ = problem
    S = S.copy()
    S[:, 6] *= unit
    S[:, 7] = 0.5 * S[:, 8] + 1e-3 * S[:, 5]
    owner = np.array([0, 1, 2, 3, 4, 5, -1, 7, -1])
    table = gram(held, S.T @ S, S.T @ y, owner, {})
    (scored,) = table.score([(Unit((7,)),)])
    without = np.linalg.lstsq(S[:, [6, 8]], y, rcond=None)[1][0]
    rss = np.linalg.lstsq(S[:, [6, 7, 8]], y, rcond=None)[1][0]
    assert scored.gain == pytest.approx(without - rss, abs=1e-2 * (y @ y))


@pytest.mark.parametrize("share", [1.3, -1.3, 1.7, -1.7])
def test_a_linear_estimate_may_lie_as_far_beyond_one_bound_as_beyond_the_other(share) -> None:
    member = fake("spring", "a", low=-10.0, high=10.0)
    S = np.array([1.0, -2.0, 0.5] * 4)[:, None]
    y = share * 10.0 * S[:, 0]
    table = gram([member], S.T @ S, S.T @ y, np.array([0]), {})
    assert len(table.score([(Unit((0,)),)])) == (abs(share) < 1.5)


def test_the_pair_is_found_where_greedy_selection_takes_the_decoy(problem) -> None:
    held, S, y, owner = problem
    found = search(gram(held, S.T @ S, S.T @ y, owner, {}), 3)
    assert found[1][0].members == (4,)
    assert set(found[2][0].members) == {0, 1}


def test_fixed_members_adapt(problem) -> None:
    held, S, y, owner = problem
    table = gram(held, S.T @ S, S.T @ y, owner, {}, fixed=(0,))
    best = search(table, 1)[1][0]
    assert best.members == (1,)
    exact = np.linalg.lstsq(S[:, [1, 0, 8]], y, rcond=None)[0][0]
    assert best.x[0] == pytest.approx(exact, rel=1e-3)


def test_a_group_loses_the_members_that_would_be_negative() -> None:
    rng = np.random.default_rng(1)
    S = rng.normal(size=(300, 4))
    y = S @ np.array([1.0, 2.0, -3.0, 0.5])
    held = [fake("dry", f"j{k}", 0.0, grouped=True) for k in range(4)]
    (unit,) = groups(held)
    assert unit == Unit((0, 1, 2, 3), "dry")
    table = gram(held, S.T @ S, S.T @ y, np.arange(4), {})
    scored = [s for s in search(table, 1, (unit,))[1] if s.units[0].group == "dry"]
    assert scored[0].members == (0, 1, 3)
    exact = lsq_linear(S, y, (0.0, np.inf)).x
    np.testing.assert_allclose(scored[0].x, exact[[0, 1, 3]], rtol=1e-3)


def test_sets_of_groups_are_scored() -> None:
    rng = np.random.default_rng(2)
    S = rng.normal(size=(300, 6))
    y = S @ np.array([1.0, 2.0, 3.0, 4.0, 0.0, 0.0])
    held = [fake(e, f"j{k}", 0.0, grouped=True) for e in ("dry", "arm", "visc") for k in range(2)]
    found = search(gram(held, S.T @ S, S.T @ y, np.arange(6), {}), 3, groups(held))
    assert {u.group for u in found[2][0].units} == {"dry", "arm"}


def test_a_refinement_counts_as_two(problem) -> None:
    held, S, y, owner = problem
    held[1] = fake("e1", "a", weight=2)
    found = search(gram(held, S.T @ S, S.T @ y, owner, {}), 2)
    assert all(1 not in s.members for s in found[2])


def test_dead_columns_are_left_out(problem) -> None:
    held, S, y, owner = problem
    S[:, 5] = 2 * S[:, 8] + 1e-3 * S[:, 5]  # nothing is left beside the nuisance
    table = gram(held, S.T @ S, S.T @ y, owner, {})
    assert 5 not in table.living()


def test_what_adapts_may_say_nothing(problem) -> None:
    held, S, y, owner = problem
    S[:, [0, 8]] = 0.0  # no column that could take anything over
    table = gram(held, S.T @ S, S.T @ y, owner, {}, fixed=(0,))
    (scored,) = table.score([(Unit((3,)),)])
    exact = np.linalg.lstsq(S[:, [3]], y, rcond=None)[0]
    np.testing.assert_allclose(scored.x, exact, rtol=1e-5)


@pytest.mark.parametrize(
    ("one", "two", "clash"),
    [
        (fake("dry", "a"), fake("dry", "b"), False),
        (fake("dry", "a"), fake("dry", "a"), True),
        (fake("stribeck", "a", nested="dry"), fake("dry", "a"), True),
        (fake("stribeck", "a", nested="dry"), fake("dry", "b"), False),
    ],
)
def test_what_excludes_what(one, two, clash: bool) -> None:
    assert clashes([one, two]) is clash
