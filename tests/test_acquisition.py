"""Acquisitions against hand-computed numbers, and the properties that all of them share."""

import math
import subprocess
import sys

import numpy as np
import pytest
import torch
from botorch.acquisition import AcquisitionFunction
from botorch.exceptions import UnsupportedError
from botorch.optim import optimize_acqf_discrete
from botorch.sampling.stochastic_samplers import StochasticSampler
from botorch.utils.testing import MockModel, MockPosterior

from bo_sysid.acquisition import (
    SelectionContext,
    acquisition_names,
    build_acquisition,
    register_acquisition,
)
from bo_sysid.acquisition import registry as registry_module
from bo_sysid.acquisition.argmin_entropy import ArgminEntropyContribution
from bo_sysid.acquisition.rows import RowAcquisition, pick, pick_batch
from bo_sysid.belief.argmin import ArgminBelief, argmin_probability
from bo_sysid.belief.surrogate import fit_surrogate
from bo_sysid.errors import StudyError

BOUNDS = np.array([[-1.0, 0.0], [1.0, 3.0]])


@pytest.fixture(scope="module")
def context():
    axes = np.meshgrid(np.linspace(-1, 1, 9), np.linspace(0, 3, 7), indexing="ij")
    candidates = np.stack([a.ravel() for a in axes], axis=1)
    deviations = np.sqrt(0.04 + (candidates[:, 0] - 0.25) ** 2 + (candidates[:, 1] - 1) ** 2)
    evaluated = np.array([3, 17, 30, 44, 55, 61])
    surrogate = fit_surrogate(candidates[evaluated], deviations[evaluated], BOUNDS, seed=0)
    belief = argmin_probability(surrogate, candidates, seed=0)
    return SelectionContext(surrogate, belief, candidates, evaluated, seed=4)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
class TestArgminEntropyOnAMock:
    """Eight joint samples at four candidates: minima at rows 0 (4), 1 (2), 2 (1.5), 3 (0.5)."""

    DRAWS = (
        (0, 1, 1, 1),
        (0, 1, 1, 1),
        (-1, 1, 1, 1),
        (0, 1, 1, 2),
        (3, 2, 4, 5),
        (3, -2, 4, 5),
        (3, 3, 2, 5),
        (3, 3, 2, 2),
    )
    EXPECTED = (0.5 * math.log(2), 0.25 * math.log(4), 0.0, 0.0)

    def acquisition(self, dtype):
        candidates = torch.tensor([[0.1, 0.2], [0.3, 0.4], [0.5, 0.6], [0.7, 0.8]], dtype=dtype)
        draws = torch.tensor(self.DRAWS, dtype=dtype).unsqueeze(-1)
        posterior = MockPosterior(samples=draws, base_shape=torch.Size([4, 1]))
        model = MockModel(posterior)
        return candidates, ArgminEntropyContribution(
            model, candidates, sampler=StochasticSampler(torch.Size([8]))
        )

    def expected(self, dtype):
        p = (0.5, 0.25, 1.5 / 8, 0.5 / 8)
        return torch.tensor([-v * math.log(v) for v in p], dtype=dtype)

    def test_values(self, dtype):
        candidates, acquisition = self.acquisition(dtype)
        values = acquisition(candidates.unsqueeze(-2))
        assert values.dtype == dtype
        torch.testing.assert_close(values, self.expected(dtype))
        assert values[0].item() == pytest.approx(0.5 * math.log(2))
        assert values[1].item() == pytest.approx(0.25 * math.log(4))

    def test_batch_shapes(self, dtype):
        candidates, acquisition = self.acquisition(dtype)
        expected = self.expected(dtype)
        torch.testing.assert_close(acquisition(candidates[[2]]), expected[[2]])
        X = candidates[torch.tensor([[0, 1, 3], [3, 3, 2]])].unsqueeze(-2)
        torch.testing.assert_close(acquisition(X), expected[torch.tensor([[0, 1, 3], [3, 3, 2]])])

    def test_best_of_the_discrete_set(self, dtype):
        candidates, acquisition = self.acquisition(dtype)
        # −P log P is the same at 1/2 and 1/4; a tie goes to the first
        best, value = optimize_acqf_discrete(acquisition, q=1, choices=candidates)
        torch.testing.assert_close(best, candidates[[0]])
        assert value.item() == pytest.approx(0.5 * math.log(2))
        best, _ = optimize_acqf_discrete(
            acquisition, q=1, choices=candidates, X_avoid=candidates[:2]
        )
        torch.testing.assert_close(best, candidates[[2]])

    def test_pending_rows_are_not_chosen_again(self, dtype):
        candidates, acquisition = self.acquisition(dtype)
        assert acquisition.X_pending is None
        acquisition.set_X_pending(candidates[[1]])
        values = acquisition(candidates.unsqueeze(-2))
        assert values[1] == -torch.inf
        torch.testing.assert_close(values[[0, 2, 3]], self.expected(dtype)[[0, 2, 3]])
        acquisition.set_X_pending(None)
        chosen, values = optimize_acqf_discrete(acquisition, q=3, choices=candidates, unique=False)
        torch.testing.assert_close(chosen, candidates[[0, 1, 2]])
        torch.testing.assert_close(values, self.expected(dtype)[[0, 1, 2]])

    def test_certainty_has_no_entropy(self, dtype):
        candidates, _ = self.acquisition(dtype)
        certain = torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=dtype)
        acquisition = ArgminEntropyContribution(None, candidates, certain)
        assert acquisition(candidates.unsqueeze(-2)).tolist() == [0.0] * 4

    def test_the_maximum_of_negated_draws_is_the_minimum(self, dtype):
        candidates, _ = self.acquisition(dtype)
        draws = -torch.tensor(self.DRAWS, dtype=dtype).unsqueeze(-1)
        model = MockModel(MockPosterior(samples=draws, base_shape=torch.Size([4, 1])))
        acquisition = ArgminEntropyContribution(
            model, candidates, sampler=StochasticSampler(torch.Size([8])), maximize=True
        )
        torch.testing.assert_close(acquisition(candidates.unsqueeze(-2)), self.expected(dtype))

    def test_a_model_of_several_outputs_is_refused(self, dtype):
        candidates, _ = self.acquisition(dtype)
        two = MockModel(MockPosterior(samples=torch.zeros(8, 4, 2, dtype=dtype)))
        assert two.num_outputs == 2
        with pytest.raises(UnsupportedError, match="needs a posterior_transform"):
            ArgminEntropyContribution(two, candidates)

    def test_point_that_is_no_candidate(self, dtype):
        candidates, acquisition = self.acquisition(dtype)
        with pytest.raises(ValueError, match="is not a candidate"):
            acquisition(candidates[[0]] * (1 + 1e-6))

    def test_probabilities_of_another_set(self, dtype):
        candidates, _ = self.acquisition(dtype)
        with pytest.raises(ValueError, match="do not belong to candidates"):
            ArgminEntropyContribution(None, candidates, torch.ones(3, dtype=dtype))
        with pytest.raises(ValueError, match="model or probabilities"):
            ArgminEntropyContribution(None, candidates)


def test_rows_are_found_after_a_cast() -> None:
    """Candidates that single precision rounds."""
    candidates = torch.tensor(np.random.default_rng(0).uniform(size=(20, 3)))
    values = torch.arange(20, dtype=torch.float64)
    moved = RowAcquisition(candidates, values).to(torch.float32)
    assert moved(candidates.float().unsqueeze(-2)).tolist() == values.tolist()
    back = moved.to(torch.float64)
    assert back(candidates.float().double().unsqueeze(-2)).tolist() == values.tolist()


@pytest.mark.parametrize("name", acquisition_names())
class TestEveryAcquisition:
    def test_values_are_finite_and_of_the_right_shape(self, context, name):
        acquisition = build_acquisition(name, context)
        assert isinstance(acquisition, AcquisitionFunction)
        with torch.no_grad():
            values = acquisition(context.choices.unsqueeze(-2))
        assert values.shape == (len(context.candidates),)
        assert values.dtype == torch.float64
        assert torch.isfinite(values).all()

    def test_batches_do_not_change_values(self, context, name):
        acquisition = build_acquisition(name, context)
        with torch.no_grad():
            together = acquisition(context.choices[:12].unsqueeze(-2))
            apart = torch.cat([acquisition(p[None]) for p in context.choices[:12]])
            nested = acquisition(context.choices[:12].reshape(3, 4, 1, 2))
        torch.testing.assert_close(together, apart)
        torch.testing.assert_close(together.reshape(3, 4), nested)

    @pytest.mark.filterwarnings("ignore::linear_operator.utils.warnings.NumericalWarning")
    def test_all_of_it_moves_as_a_module_does(self, context, name):
        """As to a GPU; every candidate here is the same number in single precision.

        Evaluated ones are left out: nothing can improve there, and rounding decides by how little.
        """
        left = np.setdiff1d(np.arange(len(context.candidates)), context.evaluated)
        points = context.choices[left].unsqueeze(-2)
        moved = build_acquisition(name, context).to(torch.float32)
        stayed = build_acquisition(name, context)
        for pending in (None, context.choices[[8, 20]]):
            stayed.set_X_pending(pending)
            moved.set_X_pending(None if pending is None else pending.float())
            with torch.no_grad():
                values, expected = moved(points.float()), stayed(points)
            assert values.dtype == torch.float32
            torch.testing.assert_close(values.double(), expected, rtol=0.02, atol=0.02)

    def test_pick_leaves_out_what_was_evaluated(self, context, name):
        acquisition = build_acquisition(name, context)
        row = pick(acquisition, context.candidates, context.evaluated)
        assert row not in context.evaluated
        left = np.setdiff1d(np.arange(len(context.candidates)), [5, 6])
        assert pick(acquisition, context.candidates, left) in (5, 6)

    def test_same_state_same_pick(self, context, name):
        rows = [
            pick(build_acquisition(name, context), context.candidates, context.evaluated)
            for _ in range(2)
        ]
        assert rows[0] == rows[1]

    def test_batch_has_different_rows(self, context, name):
        rows = pick_batch(
            build_acquisition(name, context), context.candidates, context.evaluated, 3
        )
        assert len(set(rows) - set(context.evaluated)) == 3


def values_of(name, context):
    with torch.no_grad():
        return build_acquisition(name, context)(context.choices.unsqueeze(-2)).numpy()


def test_argmin_entropy_is_the_term_of_the_beliefs_entropy(context):
    values = values_of("argmin-entropy", context)
    assert values.sum() == pytest.approx(context.belief.entropy)


def test_greedy_picks_the_most_probable_candidate_that_is_left(context):
    P = np.zeros(len(context.candidates))
    P[[3, 9, 20]] = 0.5, 0.2, 0.3  # the first was evaluated
    belief = ArgminBelief(P, "exact", 0.0)
    known = SelectionContext(
        context.surrogate, belief, context.candidates, context.evaluated, seed=4
    )
    acquisition = build_acquisition("greedy", known)
    assert pick(acquisition, context.candidates, context.evaluated) == 20
    assert pick(acquisition, context.candidates, np.array([3, 20])) == 9


def test_minimum_mean_is_the_surrogates_mean(context):
    mean, _ = context.surrogate.moments(context.candidates)
    np.testing.assert_allclose(values_of("minimum-mean", context), -mean, atol=1e-4)


def test_random_and_sobol_depend_on_seed_and_step(context):
    for name in ("random", "sobol"):
        other = SelectionContext(
            context.surrogate, context.belief, context.candidates, context.evaluated, seed=5
        )
        later = SelectionContext(
            context.surrogate,
            context.belief,
            context.candidates,
            np.append(context.evaluated, 0),
            seed=4,
        )
        picks = {int(values_of(name, c).argmax()) for c in (context, other, later)}
        assert len(picks) > 1


def test_sobol_fills_the_box(context):
    """Sixteen picks put four candidates into each quarter of the box, more or less."""
    rows: list[int] = []
    for _ in range(16):
        state = SelectionContext(
            context.surrogate, context.belief, context.candidates, np.array(rows, dtype=int)
        )
        rows.append(pick(build_acquisition("sobol", state), context.candidates, state.evaluated))
    u = context.surrogate.unit(context.candidates[rows]) > 0.5
    quarters = np.bincount(2 * u[:, 0] + u[:, 1], minlength=4)
    assert quarters.min() >= 2


def test_pick_skips_rows_equal_to_excluded_ones():
    candidates = np.array([[0.0, 1.0], [2.0, 3.0], [0.0, 1.0], [4.0, 5.0]])
    values = RowAcquisition(torch.tensor(candidates), torch.tensor([9.0, 1.0, 9.0, 2.0]))
    assert pick(values, candidates, np.array([2])) == 3
    assert pick_batch(values, candidates, np.array([2]), 9).tolist() == [3, 1]
    with pytest.raises(ValueError, match="every candidate has been evaluated"):
        pick(values, candidates, np.array([0, 1, 3]))


def test_context_refuses_the_belief_of_another_set(context):
    with pytest.raises(ValueError, match="does not belong to a set of 5"):
        SelectionContext(
            context.surrogate, context.belief, context.candidates[:5], context.evaluated
        )


def test_unknown_name_gets_the_nearest(context):
    with pytest.raises(StudyError, match=r"no acquisition 'argmin_entropy'.*'argmin-entropy'"):
        build_acquisition("argmin_entropy", context)


def test_user_added_acquisition(context, monkeypatch):
    monkeypatch.setattr(registry_module, "_ADDED", {})

    @register_acquisition("last-row")
    def last_row(state):
        return RowAcquisition(state.choices, torch.arange(len(state.candidates)))

    assert "last-row" in acquisition_names()
    acquisition = build_acquisition("last-row", context)
    assert pick(acquisition, context.candidates, context.evaluated) == len(context.candidates) - 1
    for taken in ("last-row", "greedy"):
        with pytest.raises(StudyError, match="exists already"):
            register_acquisition(taken)


def test_names_are_known_without_torch():
    code = (
        "import sys; from bo_sysid.acquisition import acquisition_names; "
        "assert 'argmin-entropy' in acquisition_names(); assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)  # noqa: S603 - our own code


def test_belief_with_all_mass_on_evaluated_rows_leaves_nothing_to_gain(context):
    P = np.zeros(len(context.candidates))
    P[context.evaluated[0]] = 1.0
    done = SelectionContext(
        context.surrogate, ArgminBelief(P, "exact", 0.0), context.candidates, context.evaluated
    )
    assert values_of("argmin-entropy", done).max() == 0.0
