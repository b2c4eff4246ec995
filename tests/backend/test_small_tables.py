"""Small tables: sent to the device once, with correct contents."""

import torch

from torch_backend.small_tables import small_table


def test_equal_tables_share_a_tensor():
    cpu = torch.device("cpu")
    one = small_table(((1.0, 2.0), (3.0, 4.5)), torch.float32, cpu)
    assert one.tolist() == [[1.0, 2.0], [3.0, 4.5]] and one.dtype == torch.float32
    assert small_table(((1.0, 2.0), (3.0, 4.5)), torch.float32, cpu) is one
    assert small_table(((1.0, 2.0), (3.0, 4.0)), torch.float32, cpu)[1, 1] == 4.0
    assert small_table(((1, 2),), torch.int64, cpu).dtype == torch.int64
