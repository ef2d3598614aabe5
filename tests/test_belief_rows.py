"""Rows are found by exact equality, as a slow double loop finds them."""

import numpy as np

from bo_sysid.belief.rows import RowIndex


def test_against_a_double_loop():
    rng = np.random.default_rng(0)
    points = rng.integers(-3, 3, size=(300, 3)) / 7.0
    queries = np.concatenate([rng.integers(-4, 4, size=(200, 3)) / 7.0, points[:50]])
    expected = [next((i for i, p in enumerate(points) if (p == q).all()), -1) for q in queries]
    assert RowIndex.of(points).find(queries).tolist() == expected


def test_single_precision_rows_are_found_in_double():
    points = np.random.default_rng(0).random((20, 2)).astype(np.float32)
    assert RowIndex.of(points.astype(float)).find(points.astype(float)).tolist() == list(range(20))


def test_nearly_equal_is_not_equal_and_signed_zeros_are():
    index = RowIndex.of(np.array([[0.0, 1.0]]))
    queries = np.array([[-0.0, 1.0], [0.0, np.nextafter(1.0, 2.0)]])
    assert index.find(queries).tolist() == [0, -1]
