"""How far vectors lead beside the true surface."""

import numpy as np

from benchmarks.vectors import off_truth

K = np.array([[100.0, 0.0, 4.0], [0.0, 100.0, 3.0], [0.0, 0.0, 1.0]])


def test_a_vector_is_judged_by_where_the_next_camera_sees_the_true_point():
    """The camera goes 0.1 to the right and 0.05 down: at depth 2 the world moves 5 px to the left and 2.5 up."""
    depth = np.full((6, 8), 2.0)
    depth[0, 0] = np.inf
    later = np.eye(4)
    later[:2, 3] = -0.1, -0.05
    vector = np.tile([-5.0, 2.5], (6, 8, 1))
    vector[2, 3] = -5.0, 5.5
    off = off_truth(depth, (np.eye(4), K), (later, K), vector)
    assert np.isinf(off[0, 0])
    np.testing.assert_allclose(off[2, 3], 3.0)
    off[0, 0] = off[2, 3] = 0.0
    np.testing.assert_allclose(off, 0.0, atol=1e-12)
