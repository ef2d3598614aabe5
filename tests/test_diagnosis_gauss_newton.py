"""Steps of fits against NumPy's least squares, within bounds and damped."""

from dataclasses import replace

import numpy as np
import pytest

from bo_sysid.diagnosis.sets.gauss_newton import LeastSquares, broyden

SCALES = np.array([1.0, 1e-3, 50.0])  # columns in units that have nothing in common
WIDE = np.full(3, 1e9)


def local(high=WIDE) -> LeastSquares:
    rng = np.random.default_rng(0)
    S = rng.normal(size=(4, 25, 3)) * SCALES
    return LeastSquares(S, rng.normal(size=(4, 25)), np.zeros(3), -WIDE, high, 1.0 / SCALES)


def by_numpy(squares: LeastSquares, free: list[int]) -> np.ndarray:
    A, step = squares.S.reshape(-1, 3)[:, free], np.zeros(3)
    step[free] = np.linalg.lstsq(A, squares.y.ravel(), rcond=None)[0]
    return step


def test_a_free_step_is_that_of_least_squares():
    np.testing.assert_allclose(local().step(1e-12), by_numpy(local(), [0, 1, 2]), rtol=1e-9)


def test_a_magnitude_at_its_bound_stays_where_the_step_would_push_it_out():
    high, upwards = WIDE.copy(), np.sign(by_numpy(local(), [0, 1, 2]))
    high[1] = 0.0
    bounded = replace(local(high=high), S=upwards * local().S)
    step = bounded.step(1e-12)
    assert step[1] == 0.0
    np.testing.assert_allclose(step, by_numpy(bounded, [0, 2]), rtol=1e-9)


def test_what_a_step_promises_is_what_the_squares_fall_by():
    squares = local()
    step = squares.step(0.3)
    left = squares.y - squares.S @ step
    fallen = (squares.y**2).sum() - (left**2).sum()
    assert squares.promised(step) == pytest.approx(fallen)
    best = squares.promised(by_numpy(squares, [0, 1, 2]))
    assert best > squares.promised(step) > 0
    assert squares.promised(np.zeros(3)) == 0.0


def test_a_damped_step_minimises_the_squares_and_its_own_size():
    squares, variance = local(), 5.0
    step = squares.step(0.0, variance)
    size = 3.0 / SCALES
    whole = np.vstack([squares.S.reshape(-1, 3), np.diag(np.sqrt(variance) / size)])
    wanted = np.concatenate([squares.y.ravel(), np.zeros(3)])
    np.testing.assert_allclose(step, np.linalg.lstsq(whole, wanted, rcond=None)[0], rtol=1e-9)


def test_the_updated_jacobian_reproduces_the_step_that_was_seen():
    squares, moved = local(), np.array([0.2, -30.0, 0.01])
    seen = squares.S @ moved + 0.3 * squares.y
    np.testing.assert_allclose(broyden(squares.S, moved, seen) @ moved, seen, atol=1e-12)
    assert broyden(np.zeros((1, 2, 3)), moved, np.ones((1, 2))).any() == 0
