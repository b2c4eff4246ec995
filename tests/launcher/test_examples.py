"""What ships with the repository may ship."""

from pathlib import Path

import splannequin


def test_the_bundled_clip_carries_its_licence_and_credit():
    credit = (splannequin.DEMO_CLIP.parent / "README.md").read_text(encoding="utf-8")
    assert splannequin.DEMO_CLIP.stat().st_size < 6_000_000
    for needed in (splannequin.DEMO_CLIP.name, "Creative Commons Attribution 4.0", "J. Sturm", "IROS 2012"):
        assert needed in credit


def test_no_other_footage_is_bundled():
    footage = {p.name for p in Path(splannequin.DEMO_CLIP).parent.iterdir() if p.suffix != ".md"}
    assert footage == {splannequin.DEMO_CLIP.name}
