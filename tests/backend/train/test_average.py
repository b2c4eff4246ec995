"""A run keeps the mean of its last steps: compared with float64, after a kill, and on held-out frames."""

from __future__ import annotations

import torch

from torch_backend.train.average import ParameterMean


def test_the_mean_is_that_of_the_steps_after_the_last_change_of_shape():
    generator, mean = torch.Generator().manual_seed(0), ParameterMean()
    mean.add({"a": torch.ones(7, 3), "b": torch.ones(2)})
    steps = [{n: torch.randn(s, generator=generator) for n, s in (("a", (5, 3)), ("b", (2,)))} for _ in range(40)]
    for step in steps:
        mean.add(step)
    assert mean.count == 40
    kept = {"a": torch.zeros(5, 3), "b": torch.zeros(2)}
    mean.copy_into(kept)
    for name, value in kept.items():
        exact = torch.stack([step[name].double() for step in steps]).mean(0)
        torch.testing.assert_close(value.double(), exact, rtol=1e-5, atol=1e-6)
    assert mean.count == 0 and mean.state() == {}


def test_a_mean_goes_on_where_it_was_saved():
    generator, whole, first, second = (
        torch.Generator().manual_seed(1),
        ParameterMean(),
        ParameterMean(),
        ParameterMean(),
    )
    for n in range(10):
        step = {"a": torch.randn(4, generator=generator)}
        whole.add(step)
        (first if n < 6 else second).add(step)
        if n == 5:
            second.restore(first.state(), torch.device("cpu"))
    kept, expected = {"a": torch.zeros(4)}, {"a": torch.zeros(4)}
    second.copy_into(kept)
    whole.copy_into(expected)
    assert torch.equal(kept["a"], expected["a"])


def test_what_is_not_finite_once_does_not_spoil_what_is_kept():
    mean, kept = ParameterMean(), {"a": torch.tensor([5.0, 6.0])}
    mean.add({"a": torch.tensor([1.0, torch.nan])})
    mean.add({"a": torch.tensor([3.0, 2.0])})
    mean.copy_into(kept)
    assert kept["a"].tolist() == [2.0, 6.0]


def test_without_a_step_nothing_changes():
    mean, kept = ParameterMean(), {"a": torch.tensor([5.0])}
    mean.copy_into(kept)
    assert kept["a"].item() == 5.0
