"""Mixed sets B: ordered parameters and categories, whose codes mean nothing."""

import itertools

import numpy as np
import pytest
import torch

from bo_sysid.acquisition import acquisition_names
from bo_sysid.belief.argmin import argmin_probability
from bo_sysid.belief.encoding import encoded
from bo_sysid.belief.stopping import StopRule
from bo_sysid.belief.surrogate import fit_surrogate
from bo_sysid.deviation import Evaluation
from bo_sysid.identify.search import History, Rules, search
from bo_sysid.parameters import CandidateSet, Parameter
from bo_sysid.study import Study

KINDS = np.array([0.0, 1.0, 2.0, 3.0])
OFFSET = np.array([0.9, 0.1, 1.2, 0.4])  # of each kind: its codes tell nothing about it


def mixed(steps: int = 15) -> CandidateSet:
    return CandidateSet.from_grid(
        (
            Parameter("x", ("a",), -1.0, 1.0, steps),
            Parameter("kind", ("b",), 0.0, 3.0, 4, ordered=False),
        )
    )


def delta(points: np.ndarray) -> np.ndarray:
    kind = points[:, 1].astype(int)
    return np.asarray(0.1 + (points[:, 0] - 0.2) ** 2 + OFFSET[kind])


def test_a_category_stands_for_itself_alone() -> None:
    """Beside it a parameter is as fine as its values in one category are."""
    x, kind = mixed().parameters
    np.testing.assert_allclose(mixed(21).cell, [0.1, 0.0])
    drawn = CandidateSet.from_sobol((x, kind), 256)
    np.testing.assert_allclose(drawn.cell, [2.0 / 64, 0.0])
    in_one = np.sort(drawn.points[drawn.points[:, 1] == 2.0, 0])
    assert np.mean(np.diff(in_one)) == pytest.approx(drawn.cell[0], rel=0.1)
    np.testing.assert_array_equal(CandidateSet.from_sobol((kind,), 4).cell, [0.0])


def test_distances_between_categories_are_equal_and_those_within_one_untouched() -> None:
    points = np.array([[-1.0, 0.0], [-1.0, 1.0], [-1.0, 3.0], [1.0, 3.0]])
    bounds = np.array([[-1.0, 0.0], [1.0, 3.0]])
    x = encoded(points, bounds, {1: KINDS})
    squared = ((x[:, None] - x[None]) ** 2).sum(axis=2)
    expected = [[0, 1, 1, 2], [1, 0, 1, 2], [1, 1, 0, 1], [2, 2, 1, 0]]
    np.testing.assert_allclose(squared, expected, atol=1e-12)
    with pytest.raises(ValueError, match=r"column 1: 1.5 is none of the categories"):
        encoded(np.array([[0.0, 1.5]]), bounds, {1: KINDS})
    np.testing.assert_allclose(encoded(points, bounds, {}), (points - bounds[0]) / [2.0, 3.0])


def test_other_codes_give_the_same_belief() -> None:
    candidates = mixed()
    rows = np.random.default_rng(0).permutation(len(candidates))[:12]
    values = delta(candidates.points[rows])
    surrogate = fit_surrogate(
        candidates.points[rows], values, candidates.bounds, categories={1: KINDS}
    )
    swapped = np.array([2.0, 0.0, 3.0, 1.0])  # the code that each kind has now
    points = candidates.points.copy()
    points[:, 1] = swapped[points[:, 1].astype(int)]
    other = fit_surrogate(points[rows], values, candidates.bounds, categories={1: swapped})
    np.testing.assert_array_equal(
        argmin_probability(surrogate, candidates.points).probabilities,
        argmin_probability(other, points).probabilities,
    )


def test_what_has_no_order_is_predicted_better_without_one() -> None:
    candidates = mixed()
    gains = []
    for seed in range(6):
        rows = np.random.default_rng(seed).permutation(len(candidates))
        known, unseen = rows[:14], rows[14:]
        errors = []
        for categories in ({1: KINDS}, {}):
            surrogate = fit_surrogate(
                candidates.points[known],
                delta(candidates.points[known]),
                candidates.bounds,
                categories=categories,
                powers=(1.0,),
            )
            mean, _ = surrogate.moments(candidates.points[unseen])
            truth = surrogate.warp(delta(candidates.points[unseen]))
            errors.append(np.sqrt(((mean - truth) ** 2).mean()))
        gains.append(errors[1] / errors[0])
    assert np.median(gains) > 1.5
    assert min(gains) > 0.8


def test_botorch_models_are_the_members() -> None:
    candidates = mixed(9)
    rows = np.random.default_rng(1).permutation(len(candidates))[:10]
    surrogate = fit_surrogate(
        candidates.points[rows],
        delta(candidates.points[rows]),
        candidates.bounds,
        categories=candidates.categories,
        members=3,
    )
    for number, model in enumerate(surrogate.models()):
        with torch.no_grad():
            posterior = model.posterior(torch.tensor(candidates.points))
        mean, variance = surrogate.only(number).moments(candidates.points)
        np.testing.assert_allclose(posterior.mean[:, 0], mean, atol=1e-6)
        np.testing.assert_allclose(posterior.variance[:, 0], variance, atol=1e-6)


@pytest.mark.parametrize("rule", [n for n in acquisition_names() if n != "full-grid"])
def test_every_rule_searches_a_mixed_set(rule: str) -> None:
    candidates = mixed(11)
    table = delta(candidates.points)

    def evaluate(row: int) -> Evaluation:
        return Evaluation(table[[row]], np.zeros((1, 1)), np.zeros(1))

    rules = Rules(rule, StopRule(24, entropy=None), 0)
    found = search(candidates, evaluate, rules, History.empty(1))
    assert len(set(found.history.rows)) == len(found.history)
    if rule not in ("random", "sobol"):
        assert candidates.points[found.belief.best].tolist() == pytest.approx([0.2, 1.0])


def test_a_sobol_design_takes_the_categories_in_equal_shares() -> None:
    parameters = (
        Parameter("x", ("a",), 0.0, 1.0),
        Parameter("kind", ("b",), 0.0, 2.0, 3, ordered=False),
    )
    points = CandidateSet.from_sobol(parameters, 384).points
    values, counts = np.unique(points[:, 1], return_counts=True)
    assert values.tolist() == [0.0, 1.0, 2.0]
    assert counts.min() >= 120


def test_a_study_says_which_parameter_has_no_order() -> None:
    suite = {"dm_control": {"domain": "pendulum", "task": "swingup"}}
    entries = [
        {"address": "joint[hinge].damping", "low": 0.0, "high": 1.0},
        {"name": "variant", "address": "body[pole].mass", "apply": "scale", "low": 1, "high": 3,
         "steps": 3, "ordered": False},
    ]  # fmt: skip
    study = Study.from_dict(
        {"model": suite, "recordings": {"train": ["none.csv"]}, "parameters": entries}
    )
    from bo_sysid.study.inputs import load_model
    from bo_sysid.study.overview import candidate_set

    candidates = candidate_set(study, study.parameter_set(load_model(study)))
    assert list(candidates.categories) == [1]
    assert candidates.categories[1].tolist() == [1.0, 2.0, 3.0]
    assert "ordered" not in study.resolved()["parameters"][0]
    assert len(set(itertools.chain(*candidates.points[:, 1:]))) == 3
