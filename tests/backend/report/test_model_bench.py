"""Benchmark of the model without plates: judged models and frames."""

import json
import shutil

import numpy as np

from benchmarks.model import OF_FROZEN, main
from torch_backend.footage.images import read_png, write_png
from torch_backend.sfm.masks import write_grey
from torch_backend.shot import Shot, write_json


def test_a_trained_run_is_judged_frozen_and_developed_on_frames_that_it_has_not_seen(trained, tmp_path):
    command = [str(trained.shot.root), "--run", "main", "--results", str(tmp_path), "--t-star", "103", "--develop"]
    # Without a large `instant_share`, developing makes this sharp run worse on plate t*, and its result is discarded.
    assert main([*command, "--develop-set", "steps=40", "gain=-99", "instant_share=0.6", "--held", "1"]) == 0
    result = json.loads((tmp_path / "model.json").read_text())
    figures = result["figures"]
    assert all(20.0 < figures[f"{kind}_large_{n}"] < 60.0 for kind in ("field", "developed") for n in OF_FROZEN[:2])
    assert figures["developed_large_frozen"] != figures["field_large_frozen"]
    assert result["develop_config"]["steps"] == 40
    for rows in (result["own"], result["frozen"]["developed"]["large"]):
        assert {row["frame"] for row in rows} == {109}
    assert [row["frame"] for row in result["held"]] == [109] and not list(tmp_path.glob("**/*.safetensors"))


def test_a_number_that_the_configuration_does_not_have_is_named(trained, tmp_path, capsys):
    command = [str(trained.shot.root), "--results", str(tmp_path), "--set", "gate.strat=0.4"]
    assert main(command) == 1 and "gate.strat" in capsys.readouterr().err


def test_what_the_mask_ignores_is_not_judged(trained, tmp_path):
    shot = Shot(shutil.copytree(trained.shot.root, tmp_path / "logo.splannequin"))
    plate = shot.frames / "000109.png"
    pixels = read_png(plate)
    pixels[: len(pixels) // 2] = 255 - pixels[: len(pixels) // 2]  # half of the plate shows something else

    def whole(name: str) -> float:
        assert main([str(shot.root), "--run", "main", "--results", str(tmp_path / name), "--t-star", "103"]) == 0
        return json.loads((tmp_path / name / "model.json").read_text())["figures"]["whole"]

    write_png(plate, pixels)
    spoilt = whole("spoilt")
    write_json(shot.solve_record, {"masks": {"ignore": {"key": "logo"}}})
    shot.masks("ignore").mkdir()
    for path in shot.frames.glob("*.png"):
        mask = np.zeros(pixels.shape[:2], np.uint8)
        mask[: len(pixels) // 2] = 255
        write_grey(shot.mask("ignore", int(path.stem)), mask)
    assert whole("masked") > spoilt + 3.0
