"""Numbers that count as tuned numbers of the freeze."""

from benchmarks.tuned_numbers import UNTUNED, numbers_of

TEXT = '''
_LIMIT = 0.25
_TINY = 1e-6
_NAMES = {"a": 7}
WIDTH: int = 2 * 5

@dataclass
class ThingConfig:
    """A doc with 3 numbers."""
    share: float = 1.0
    pair: tuple[float, float] = (10.0, 1e-5)
    on: bool = True
    none: float = 0.0
    made: list[int] = field(default_factory=list)

    def area(self) -> float:
        return 0.5 * self.share * 7.5 + 2 - max(1e-9, 1e6)

def grown(by: float = 1.5):
    return by * 2
'''


def test_fields_and_constants_count_whatever_they_are_and_code_but_for_what_is_trivial():
    found = [(each.name, each.value, each.kind) for each in numbers_of("views/thing.py", TEXT)]
    assert sorted(found) == sorted([
        ("_LIMIT", 0.25, "tuned"), ("_TINY", 1e-6, "guard"), ("_NAMES", 7, "tuned"), ("WIDTH", 2, "tuned"),
        ("WIDTH", 5, "tuned"), ("ThingConfig.share", 1.0, "tuned"), ("ThingConfig.pair", 10.0, "tuned"),
        ("ThingConfig.pair", 1e-5, "tuned"), ("ThingConfig.area", 7.5, "tuned"), ("ThingConfig.area", 1e-9, "guard"),
        ("ThingConfig.area", 1e6, "guard"), ("grown", 1.5, "tuned"),
    ])  # fmt: skip


def test_what_is_no_tuned_number_is_named_with_its_kind(monkeypatch):
    monkeypatch.setitem(UNTUNED, "views/thing.py:_LIMIT", "resource")
    kinds = {each.name: each.kind for each in numbers_of("views/thing.py", TEXT)}
    assert kinds["_LIMIT"] == "resource" and kinds["grown"] == "tuned"
