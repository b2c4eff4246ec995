"""One remedy, and the names of tests that several of them are for."""

import sys
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]
if str(ROOT / "tests") not in sys.path:
    sys.path.insert(0, str(ROOT / "tests"))

from proofs import Change  # noqa: E402  # pyright: ignore[reportMissingImports]


@dataclass(frozen=True)
class Remedy:
    """A text of the rasteriser that keeps a hard case harmless, and the test that knows."""

    name: str
    symbol: str
    """As in `proofs.Change`, in raster/; with another folder of torch_backend before it (train/photometric), or a file
    of raster/ (ssim.py/ssim)."""
    old: str
    new: str
    test: str
    """Function in test_hard_cases.py, or file::function."""
    body: str
    """Word in the test's id; empty for a test that has no bodies."""
    also: tuple[tuple[str, str, str], ...] = ()
    """More (symbol, old, new): what would catch the same thing once more."""

    @property
    def changes(self) -> list[Change]:
        """All that is taken out together."""
        found = []
        for symbol, old, new in ((self.symbol, self.old, self.new), *self.also):
            folder, _, name = symbol.rpartition("/")
            inside = f"raster/{folder}" if folder.endswith(".py") else folder or "raster"
            found.append(Change(f"torch_backend/{inside}", name, old, new))
        return found

    def made(self, root: Path) -> dict[Path, str]:
        """File -> its text without the remedy. LookupError, in a sentence, if it is not there any more."""
        done: dict[Path, str] = {}
        for change in self.changes:
            path, text = change.made(root, f"the remedy {self.name!r}", done)
            done[path] = text
        return done

    @property
    def full_test(self) -> str:
        """file::function."""
        return self.test if "::" in self.test else f"test_hard_cases.py::{self.test}"

    @property
    def node(self) -> str:
        return f"tests/backend/raster/{self.full_test}"

    @property
    def command(self) -> list[str]:
        words = {"": "", "reference": "reference and not reference32"}.get(self.body, self.body)
        return [self.node, *(["-k", words] if words else [])]


NON_FINITE = "test_non_finite_gaussian_is_culled_and_the_others_stay"
ENORMOUS = "test_infinite_and_enormous_scales_are_culled"
FOOTPRINT = "test_footprint_beyond_the_frustum_is_bounded_by_the_clamp"
POINT = "test_a_point_is_as_wide_as_the_low_pass"
FLOOR = "test_a_point_keeps_half_a_percent_of_its_opacity_when_antialiased"
BLACK = "test_black_harmonics_can_become_brighter_but_not_darker"
LENGTH = "test_length_of_a_quaternion_does_not_matter"
STOP = "test_pixel_stops_once_it_is_opaque"
FAINT = "test_faint_gaussians_lose_their_gradient_where_they_can_be_counted"
EDGE = "test_properties.py::test_footprints_at_the_frustum_edge_are_bounded"
CEILING = "test_colours_have_no_ceiling"
