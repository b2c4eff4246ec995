"""Metrics of hard scenes, on pictures of a few pixels."""

from __future__ import annotations

import json

import pytest
import torch

from benchmarks.report.metrics import score
from benchmarks.report.records import DELIVERED, Detailed, FrameScore, RunRecord, load_record, save_record
from benchmarks.report.tables import all_tables
from benchmarks.report.things import matte_on_panes, opened_on, recall_of, recalled
from torch_backend.motion.mattes import MOVING, PAINTED, STILL, UNKNOWN, write_matte
from torch_backend.shot import Shot

WALL, APPLE = torch.tensor([0.5, 0.5, 0.6]), torch.tensor([0.8, 0.1, 0.1])


def plain(color: torch.Tensor) -> torch.Tensor:
    return color.expand(8, 12, 3).clone()


@pytest.fixture
def apple():
    """(truth, background, mask): an apple of 4x4 pixels in front of a wall; at one pixel the wall has its colour."""
    mask = torch.zeros(8, 12, dtype=torch.bool)
    mask[2:6, 4:8] = True
    truth, behind = plain(WALL), plain(WALL)
    truth[mask] = APPLE
    behind[5, 7] = APPLE + 0.05
    return truth, behind, mask


def test_an_apple_is_recalled_where_it_is_seen(apple):
    truth, behind, mask = apple
    assert recalled(truth, truth, behind, mask) == (15, 15), "what looks as its background cannot be told"
    assert recalled(behind, truth, behind, mask) == (0, 15)
    half = behind.clone()
    half[2:4] = truth[2:4]
    assert recalled(half, truth, behind, mask) == (8, 15)


def test_a_pixel_is_recalled_if_near_the_truth_and_nearer_than_to_what_is_behind(apple):
    truth, behind, mask = apple
    soft = 0.7 * truth + 0.3 * behind
    assert recalled(soft, truth, behind, mask) == (15, 15)
    soft = 0.4 * truth + 0.6 * behind
    assert recalled(soft, truth, behind, mask) == (0, 15), "nearer to the wall"
    green = plain(torch.tensor([0.1, 0.8, 0.1]))
    assert recalled(green, truth, behind, mask) == (0, 15), "like neither"
    alike = (truth + 0.16).where(mask[..., None], truth)
    assert recalled(alike, truth, behind, mask) == (0, 15) and recalled(truth + 0.14, truth, behind, mask) == (15, 15)
    close = truth.lerp(behind, 0.3)  # 0.12 from the truth, but only 0.08 from the background
    assert recalled(close, truth, truth.lerp(behind, 0.5), mask)[0] == 0


def test_recall_needs_a_known_background(apple):
    truth, behind, mask = apple
    regions = {"swinging": mask, "hair": mask}
    assert recall_of({"swinging": behind}, truth, truth, regions) == {"swinging": [15, 15]}
    assert recall_of({}, truth, truth, regions) == {}


def test_pane_is_counted_open_where_the_matte_marks_motion():
    pane = torch.zeros(8, 12, dtype=torch.bool)
    pane[:, :4] = True
    motion = torch.zeros(8, 12)
    motion[:2], motion[2:4] = 0.9, 0.4
    assert opened_on(motion, {"glass": pane, "mirror": ~pane & False, "wall": pane}) == {"glass": 0.25}


class Framed:
    """Two frames with a pane: it covers the left half of the first frame and the whole second frame."""

    def __init__(self, shot: Shot) -> None:
        self.shot = shot

    def frame_regions(self, frame: int, width: int, height: int) -> dict[str, torch.Tensor]:
        glass = torch.ones(height, width, dtype=torch.bool)
        if frame == 1:
            glass[:, width // 2 :] = False
        return {"moving": ~glass, "glass": glass}


def test_the_matte_on_panes_is_a_share_of_their_pixels(tmp_path):
    shot = Shot.create(tmp_path / "panes.splannequin")
    shot.update(width=16, height=4)
    first, second = (torch.full((4, 16), STILL, dtype=torch.uint8).numpy() for _ in range(2))
    first[:, :4], first[:, 8:] = MOVING, MOVING  # the right part is outside the pane
    second[:, :8] = UNKNOWN
    for frame, labels in ((1, first), (2, second)):
        write_matte(shot.root / PAINTED / f"{frame:06d}.png", labels)
    found = matte_on_panes(Framed(shot), [1, 2], 16, 4)  # type: ignore[arg-type]
    assert found == {"glass": {"moving": pytest.approx(16 / 96), "unknown": pytest.approx(32 / 96)}}


def record(host: str, supervision: str, counts: list[list[int]], error: float) -> RunRecord:
    """Record of two poses: recall counts of an apple, glass with error `error`, a wall with half of it."""
    glass = torch.zeros(30, 40, dtype=torch.bool)
    glass[:, :20] = True
    truth = torch.full((30, 40, 3), 0.5)
    image = truth + torch.where(glass, error, error / 2)[..., None]
    rows = []
    for pose, count in enumerate(counts):
        scores = score(image, truth, {"glass": glass, "wall": ~glass})
        rows.append(FrameScore(9, pose, False, scores, recalled={"swinging": count}, opened={"glass": 0.02}))
    return RunRecord(
        f"hard-{host}-{supervision}", "quick glass-000", "synthetic", "exact", host, supervision, "preview", "default",
        0, "nearest", 100, 40, 30, 1.0, 1.0, 1, 1, 1.0, 10, 0.1, 10, 1.0, 30.0, rows,
        matte={"glass": {"moving": 0.03, "unknown": 0.4}},
        detailed={DELIVERED: Detailed([FrameScore(9, 0, False, rows[0].regions, recalled={"swinging": [18, 20]})])},
    )  # fmt: skip


def test_the_report_tells_of_glass_and_small_movers(tmp_path):
    rows = record("auto", "support", [[10, 20], [4, 5], [30, 30]], 0.1)
    again = load_record(save_record(tmp_path, rows))
    assert again == rows and json.loads((tmp_path / f"{rows.run_id}.json").read_text())["matte"] == rows.matte
    tables = {table.title: table for table in all_tables([again])}
    ours, delivered = tables["Glass and mirrors"].rows
    assert ours == [
        "auto (ours)", "20.00", "–", "26.02", "-6.02", "–", "2.0%", "–", "3.0% (40.0%)", "–",
    ]  # fmt: skip
    assert delivered[6] == "–", "plate detail opens nothing"
    assert tables["Small moving objects and hair"].rows == [
        ["auto (ours)", "0.80", "0.50", "–", "–", "–", "–"],
        ["auto (ours), plate detail", "0.90", "0.90", "–", "–", "–", "–"],
    ]


def test_scenes_without_hard_objects_have_no_object_tables():
    rows = record("auto", "support", [[1, 1]], 0.1)
    for row in rows.rows:
        row.recalled, row.opened, row.regions = {}, {}, {"whole": row.regions["whole"]}
    rows.matte, rows.detailed = {}, {}
    assert not {"Glass and mirrors", "Small moving objects and hair"} & {table.title for table in all_tables([rows])}
