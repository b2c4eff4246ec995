"""The script for a GPU that is available for half an hour runs through its stages without a GPU."""

import json

import pytest

from benchmarks import gpu
from torch_backend.train.device import cuda_refusal


def test_a_dry_run_goes_through_all_parts_of_a_stage(world, tmp_path):
    contents = sorted(world.shot.root.rglob("*"))
    assert gpu.main(["limits", "--dry-run", "--shot", str(world.shot.root), "--results", str(tmp_path)]) == 0
    report = json.loads((tmp_path / "gpu-limits.json").read_text())
    assert report["dry_run"] and set(report["found"]) == {"memory_6", "resume", "freeze", "composite", "live"}
    assert not [name for name, part in report["found"].items() if "failed" in part]
    before, after = report["found"]["resume"]["cpu"]["gaussians"]
    assert after > before, "it was resumed at a round of growth"
    assert report["found"]["memory_6"]["fits"]
    assert sorted(world.shot.root.rglob("*")) == contents, "the shot itself is left alone"


def test_failed_part_is_reported_and_others_continue(tmp_path):
    stage = gpu.Stage(True, None, tmp_path)
    stage.part("without a shot", lambda: {"frames": stage.scratch_shot()})
    stage.part("after it", lambda: {"ms": 1.0})
    assert stage.found["without a shot"]["failed"] == "JobError: This part needs a solved shot."
    assert stage.found["after it"]["ms"] == 1.0
    stage.dry, stage.until = False, 0.0
    stage.part("too late", lambda: {"ms": 1.0}, needs=30.0)
    assert "30 are needed" in stage.found["too late"]["left_out"]


def test_parts_can_be_selected_by_name(tmp_path):
    assert gpu.main(["raster", "--dry-run", "--only", "host", "planes", "--results", str(tmp_path)]) == 0
    found = json.loads((tmp_path / "gpu-raster.json").read_text())["found"]
    assert set(found) == {"peer", "host", "planes"}
    assert found["host"]["ms"] > 0.0 and any("forward" in name for name in found["host"]["with_calls"])


@pytest.mark.skipif(not cuda_refusal(), reason="there is a card")
def test_without_a_card_it_says_how_to_go_on(tmp_path, capsys):
    assert gpu.main(["raster", "--results", str(tmp_path)]) == 9
    assert "--dry-run" in capsys.readouterr().err and not list(tmp_path.iterdir())
