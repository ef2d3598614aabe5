"""Parameters and the discrete set B."""

import numpy as np
import pytest

from bo_sysid.errors import StudyError
from bo_sysid.parameters import CandidateSet, Parameter

A = Parameter("a", ("joint[a].damping",), 0.0, 1.0, 3)
B = Parameter("b", ("joint[b].damping",), -1.0, 1.0, 5)


def test_a_grid_has_every_combination_last_parameter_fastest() -> None:
    grid = CandidateSet.from_grid([A, B])
    assert len(grid) == 15
    np.testing.assert_array_equal(grid.points[:5, 0], 0.0)
    np.testing.assert_array_equal(grid.points[:5, 1], [-1, -0.5, 0, 0.5, 1])
    np.testing.assert_array_equal(grid.spacing, [0.5, 0.5])
    assert len(np.unique(grid.points, axis=0)) == 15
    assert list(grid.frame().columns) == ["a", "b"]


@pytest.mark.parametrize("size", [1, 7, 1000])
def test_a_sobol_design_fills_the_box_evenly(size: int) -> None:
    design = CandidateSet.from_sobol([A, B], size, seed=3)
    assert design.points.shape == (size, 2)
    assert design.spacing is None
    low, high = design.bounds
    assert ((design.points >= low) & (design.points <= high)).all()
    if size == 1000:  # far more even than random points: the mean is exact to 1e-3
        np.testing.assert_allclose(design.points.mean(axis=0), [0.5, 0.0], atol=2e-3)
    again = CandidateSet.from_sobol([A, B], size, seed=3)
    np.testing.assert_array_equal(design.points, again.points)


def test_a_sobol_design_of_categories_has_none_twice() -> None:
    kinds = [Parameter(n, (f"joint[{n}].damping",), 0.0, 3.0, 4, ordered=False) for n in ("a", "b")]
    design = CandidateSet.from_sobol(kinds, 64)
    assert len(np.unique(design.points, axis=0)) == len(design) == 16  # all that there are
    assert len(CandidateSet.from_sobol([*kinds, B], 64)) == 64


def test_candidates_cannot_be_changed() -> None:
    grid = CandidateSet.from_grid([A])
    with pytest.raises(ValueError, match="read-only"):
        grid.points[0, 0] = 7.0


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"low": 1.0, "high": 1.0}, "low 1 must be below high 1"),
        ({"low": 0.0, "high": np.inf}, "both finite"),
        ({"low": 0.0, "high": 1.0, "steps": 1}, "steps is 1; at least 2"),
        ({"low": 0.0, "high": 1.0, "addresses": ()}, "at least one address"),
    ],
)
def test_what_is_wrong_with_a_parameter_is_said(fields: dict, message: str) -> None:
    with pytest.raises(StudyError, match=message):
        Parameter(**{"name": "p", "addresses": ("joint[a].damping",), **fields})


def test_a_grid_too_large_to_list_says_what_to_do() -> None:
    many = [Parameter(f"p{i}", ("x",), 0, 1, 100) for i in range(4)]
    with pytest.raises(StudyError, match=r"100000000 candidates.*sobol"):
        CandidateSet.from_grid(many)
    with pytest.raises(StudyError, match="sobol"):  # more than any float
        CandidateSet.from_grid(many * 50)


def test_a_candidate_stands_for_its_cell() -> None:
    parameters = (Parameter("a", ("a",), 0.0, 1.0, 5), Parameter("b", ("b",), 0.0, 4.0, 3))
    assert CandidateSet.from_grid(parameters).cell.tolist() == [0.25, 2.0]
    design = CandidateSet.from_sobol(parameters, 64)
    assert np.prod(design.cell) * 64 == pytest.approx(4.0)
    assert design.cell[1] == pytest.approx(4 * design.cell[0])
