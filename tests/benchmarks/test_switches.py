"""Rules that `benchmarks.ablate` switches off or changes affect the code that they belong to."""

import pytest

from benchmarks.ablate.switches import RULES, rules_disabled
from torch_backend.freeze.instant import repairs
from torch_backend.freeze.instant.develop import DevelopConfig


@pytest.mark.parametrize("word, factor", [("half", 0.5), ("twice", 2.0)])
def test_numbers_of_the_static_baseline_reach_its_repair(word, factor):
    usual, *_ = repairs.repairs(DevelopConfig())
    changed = 0
    for name, value in vars(usual.config).items():
        with rules_disabled(frozenset({f"{word} baseline.{name}"})):
            baseline, *_ = repairs.repairs(DevelopConfig())
        assert getattr(baseline.config, name) == pytest.approx(factor * value, abs=1.0), name
        changed += baseline.config != usual.config
    assert changed == len(vars(usual.config))
    assert repairs.repairs(DevelopConfig())[0].config == usual.config, "and is as before afterwards"


def test_every_rule_can_be_disabled():
    for name in RULES:
        with rules_disabled(frozenset({name})):
            pass
