"""Typed access to NumPy and SciPy returns the same as the functions behind it."""

import numpy as np

from torch_backend.array_types import linear_solution, meshgrid, save_arrays, sparse_entries, sparse_rows


def test_a_sparse_matrix_by_rows_is_the_dense_one():
    dense = np.array([[0, 2, 0, 1], [0, 0, 0, 0], [3, 0, 0.5, 0]], np.float32)
    weights = dense[dense != 0]
    columns, starts = np.array([1, 3, 0, 2], np.int32), np.array([0, 2, 2, 4], np.int32)
    right = np.arange(8, dtype=np.float32).reshape(4, 2)
    assert np.array_equal(sparse_rows(weights, columns, starts, 4) @ right, dense @ right)


def test_entries_at_one_place_add_up():
    rows, columns = np.array([1, 0, 1], np.int64), np.array([2, 0, 2], np.int64)
    matrix = sparse_entries(np.array([1, 5, 2], np.float32), rows, columns, (2, 3))
    assert (matrix @ np.eye(3, dtype=np.float32)).tolist() == [[5, 0, 0], [0, 0, 3]]


def test_a_grid_holds_x_and_y_of_each_place():
    x, y = meshgrid(np.arange(3), np.arange(2))
    assert x.tolist() == [[0, 1, 2]] * 2 and y.tolist() == [[0, 0, 0], [1, 1, 1]]


def test_arrays_come_back_without_pickle(tmp_path):
    save_arrays(tmp_path / "a.npz", {"xyz": np.eye(3), "model": np.array("OPENCV")})
    with np.load(tmp_path / "a.npz", allow_pickle=False) as data:
        assert sorted(data.files) == ["model", "xyz"] and str(data["model"]) == "OPENCV"
        assert np.array_equal(data["xyz"], np.eye(3))


def test_a_linear_system_is_solved():
    matrix = np.array([[2.0, 1.0], [0.0, 4.0]])
    assert np.allclose(matrix @ linear_solution(matrix, np.eye(2)), np.eye(2))
