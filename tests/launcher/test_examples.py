"""Everything that ships with the repository may be distributed."""

from pathlib import Path

from launcher import places


def test_the_bundled_clip_carries_its_licence_and_credit():
    credit = (places.DEMO_CLIP.parent / "README.md").read_text(encoding="utf-8")
    assert places.DEMO_CLIP.stat().st_size < 6_000_000
    for needed in (places.DEMO_CLIP.name, "Creative Commons Attribution 4.0", "J. Sturm", "IROS 2012"):
        assert needed in credit


def test_only_listed_footage_is_bundled():
    """Allowed are the script and the small .blend that it makes from the clip, which holds no pictures."""
    folder = Path(places.DEMO_CLIP).parent
    footage = {p.name for p in folder.iterdir() if p.suffix not in (".md", ".py") and p.is_file()}
    assert footage == {places.DEMO_CLIP.name, "sitting_frozen.blend"}
    assert (folder / "sitting_frozen.blend").stat().st_size < 1_000_000
