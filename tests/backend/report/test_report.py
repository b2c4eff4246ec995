"""Report of example records, which are built from the bundled frame with known damages."""

import json
import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.report.metrics import score
from benchmarks.report.records import (
    DELIVERED,
    DEVELOPED,
    WITHHELD,
    Detailed,
    FrameScore,
    HeldOut,
    Picture,
    RunRecord,
    load_record,
    load_records,
    machine_facts,
    save_record,
)
from benchmarks.report.tables import all_tables, comparisons, settings_of
from benchmarks.report.write import write_report
from torch_backend.footage.images import write_png

pytest.importorskip("matplotlib", reason="matplotlib is not installed")

HOSTS = [("hexplane", s) for s in ("none", "paper", "support")] + [("auto", "support"), ("static", "none")]
STRENGTH = {"none": 0.9, "paper": 0.6, "support": 0.35}


def example(results: Path, frame: torch.Tensor, scene: str, seed: int, host: str, supervision: str) -> RunRecord:
    """Record whose frames are blurred and shifted crops of a real frame; fewer anchors mean stronger damage."""
    height, width = 90, 160
    rng = np.random.default_rng([len(scene), seed, len(host), len(supervision)])
    strength = 0.3 if host == "auto" else 0.8 if host == "static" else STRENGTH[supervision]
    rows, pictures, plates = [], [], {}
    small = torch.nn.functional.interpolate(frame.permute(2, 0, 1)[None], scale_factor=0.5, mode="area")[0]
    for t_star in (8, 24):
        for pose in (0, 16, 40):
            x, y = 4 + 2 * pose, 20 + t_star // 2
            truth = small[:, y : y + height, x : x + width].permute(1, 2, 0)
            blurred = torch.nn.functional.avg_pool2d(truth.permute(2, 0, 1), 5, 1, 2).permute(1, 2, 0)
            amount = strength * (0.4 + abs(pose - t_star) / 48) * (1 + 0.1 * rng.random())
            image = (1 - amount) * truth + amount * blurred
            far = torch.zeros(height, width, dtype=torch.bool)
            far[:, : 3 * abs(pose - t_star)] = True
            moving = torch.zeros(height, width, dtype=torch.bool)
            moving[30:90, 60:110] = True
            regions = {"seen": ~far, "never_seen": far, "moving": moving, "static": ~moving}
            rows.append(FrameScore(t_star, pose, pose == 16, score(image, truth, regions), 30.0, 0.9))
            name = f"{t_star:06d}_{pose:06d}.png"
            paths = [f"pictures/{scene}-{seed}-{host}-{supervision}/{name}", f"pictures/{scene}/{name}"]
            for path, value in zip(paths, (image, truth), strict=True):
                write_png(results / path, (value * 255 + 0.5).to(torch.uint8).contiguous().numpy())
            psnr = rows[-1].value("psnr_db")
            pictures.append(Picture(t_star, pose, paths[0], paths[1], psnr))
        plates[str(t_star)] = pictures[-1].truth
    pictures.sort(key=lambda p: p.psnr_db)
    record = RunRecord(
        f"{scene}-{host}-{supervision}-s{seed}", scene, "synthetic", "exact", host, supervision, "preview", "default",
        seed, "nearest" if supervision == "support" else "plain", 3000, width, height,
        40.0 * (2 - strength) * (0.4 if host == "static" else 1), 70.0,
        1, 2, 5.0 if host == "auto" else 12.5, 4800,
        0.04 if host == "auto" else float(host != "static"), 1_900_000 if host == "static" else 2_600_000,
        240.0 - 100 * (host == "hexplane"), 28.0, rows,
        [HeldOut(f, {"whole": 28.0, "moving": 25.0 - 3 * strength, "static": None}) for f in (3, 11)],
        {"8": 8.9, "24": None}, pictures,
        [p for p in pictures if p.pose == 40], plates, {}, machine_facts(), "bench", "2026-11-21 12:00",
    )  # fmt: skip
    if host == "auto":
        gains = {DEVELOPED: 1.0, WITHHELD: 2.0, DELIVERED: 4.0}
        for shown, gain in gains.items():
            shots = [] if shown == WITHHELD else pictures
            better = [sharper(row, gain) for row in rows]
            speed = None if shown == WITHHELD else 3.0
            record.detailed[shown] = Detailed(better, {"8": 9.0, "24": None}, speed, shots, record.two_instants)
    save_record(results, record)
    return record


def sharper(row: FrameScore, gain: float) -> FrameScore:
    """The same frame with all PSNR values raised by `gain` dB."""
    regions = {
        name: {**of, "psnr_db": None if of["psnr_db"] is None else of["psnr_db"] + gain}
        for name, of in row.regions.items()
    }
    return FrameScore(row.t_star, row.pose, row.held_out, regions, 35.0, 0.99)


@pytest.fixture(scope="module")
def results(tmp_path_factory, frame):
    folder = tmp_path_factory.mktemp("examples")
    for scene in ("room-3", "ground-1"):
        for seed in (0, 1):
            for host, supervision in HOSTS:
                example(folder, frame, scene, seed, host, supervision)
    return folder


@pytest.fixture(scope="module")
def report(results):
    said = ["SC-GS is not in this report: the trainer has no host 'control_points'."]
    write_report(results, results / "report", None, said, "python3 splannequin.py bench <quick>")
    # For manual inspection: REPORT_EXAMPLE=/tmp/example pytest ...
    if os.environ.get("REPORT_EXAMPLE"):
        shutil.copytree(results / "report", os.environ["REPORT_EXAMPLE"], dirs_exist_ok=True)
    return results / "report"


def test_record_round_trips(results):
    path = next(results.glob("*.json"))
    record = load_record(path)
    save_record(results / "copy", record)
    assert (results / "copy" / path.name).read_bytes() == path.read_bytes()


def test_a_damaged_record_is_named(tmp_path):
    (tmp_path / "x.json").write_text('{"version": 4, "rows": []}')
    with pytest.raises(ValueError, match="x.json"):
        load_record(tmp_path / "x.json")
    (tmp_path / "y.json").write_text('{"version": 99}')
    with pytest.raises(ValueError, match="version 99"):
        load_record(tmp_path / "y.json")


def test_means_are_those_of_the_frames(results, report):
    tables = {t["title"]: t for t in json.loads((report / "report.json").read_text())["tables"]}
    quality = tables["Frozen frames against the rendered truth, whole frame"]
    row = next(r for r in quality["rows"] if r[0] == "4DGaussians + paper")
    values = []
    for path in results.glob("*hexplane-paper*.json"):
        values += [r["regions"]["whole"]["psnr_db"] for r in json.loads(path.read_text())["rows"]]
    assert len(values) == 24 and row[1:4] == ["at t*", "4", "24"]
    assert float(row[4]) == pytest.approx(np.mean(values), abs=0.006)
    assert float(row[7]) == pytest.approx(np.mean(sorted(values)[:6]), abs=0.006)
    assert float(row[8]) == pytest.approx(min(values), abs=0.006)
    assert quality["rows"][quality["best"]][0] == "auto (ours), plate detail"


def test_what_is_compared_with_what(results):
    names = [(a.label, b.label) for a, b in comparisons(settings_of(load_records(results), "synthetic"))]
    assert ("4DGaussians + paper", "4DGaussians") in names and ("4DGaussians + support", "4DGaussians + paper") in names
    assert ("auto (ours)", "static 3DGS") in names and ("auto (ours)", "4DGaussians + support") in names
    assert ("auto (ours), plate detail", "auto (ours)") in names
    assert ("auto (ours), plate detail, plate withheld", "auto (ours)") in names
    assert ("auto (ours), developed", "auto (ours)") in names
    assert len(names) == 9


def test_every_table_has_a_row_of_what_is_delivered(results):
    """It also has figures: by region in the table of wins, and beside splats alone in the other tables."""
    tables = {table.title: table for table in all_tables(load_records(results))}
    kinds = ("developed", "plate detail, plate withheld", "plate detail")
    for title, table in tables.items():
        for kind in kinds:
            assert any(row[0].split(" against ")[0] == f"auto (ours), {kind}" for row in table.rows), (title, kind)
    regions = {row[0]: row[1:] for row in tables["By region"].rows}
    for kind, gain in zip(kinds, (1.0, 2.0, 4.0), strict=True):
        for splats, detailed in zip(regions["auto (ours)"], regions[f"auto (ours), {kind}"], strict=True):
            assert float(detailed) - float(splats) == pytest.approx(gain, abs=0.011)
    won = [
        row for row in tables["Paired comparisons"].rows if row[0] == "auto (ours), plate detail against auto (ours)"
    ]
    assert [row[1] for row in won] == ["whole frame", "seen at t*", "never seen at t*", "moving", "static"]
    assert all(row[2] == "frozen frame 80.00" and row[3] == "+4.000" and row[-1] == "win" for row in won)
    cost = {row[0]: row for row in tables["Cost (synthetic scenes)"].rows}
    fps, moving = (tables["Cost (synthetic scenes)"].header.index(n) for n in ("frozen frames / s", "moving"))
    assert cost["auto (ours), plate detail"][fps] == "3.0" and cost["auto (ours)"][fps] == "240.0"
    # A run's own frames at their own times are not frozen frames.
    assert cost["auto (ours), plate detail"][moving] == "–" != cost["auto (ours)"][moving]


def test_ablation_is_compared_with_splats_only(results, tmp_path):
    record = load_record(next(results.glob("*auto*.json")))
    record.pictures, record.two_instants, record.detailed[DELIVERED].pictures = [], [], []
    save_record(tmp_path, record)
    record.run_id, record.variant, record.supervision = "without", "gate, no anchors", "none"
    save_record(tmp_path, record)
    table = next(t for t in all_tables(load_records(tmp_path)) if t.title == "Ablations")
    assert {row[1] for row in table.rows} == {"auto (ours)"} and {row[3] for row in table.rows} == {"+0.000"}


def test_who_wins_where_and_at_what_cost(results):
    table = next(t for t in all_tables(load_records(results)) if t.title == "Paired comparisons")
    rows = {(row[0], row[1]): dict(zip(table.header, row, strict=True)) for row in table.rows}
    row = rows["4DGaussians + support against 4DGaussians", "never seen at t*"]
    assert float(row["PSNR a - b, dB"]) > 0 and row["n"] == "4 runs" and row["verdict"] == "win"
    row = rows["auto (ours) against 4DGaussians + support", "whole frame (gate on, off)"]
    assert row["cost a / b"] == "step 0.40"
    row = rows["auto (ours) against static 3DGS", "moving, held-out frames of the clip"]
    assert float(row["PSNR a - b, dB"]) == pytest.approx(3 * (0.8 - 0.3))
    assert row["frames"] == "8" and row["verdict"] == "win"
    # Seconds are 40 (2 - strength), times 0.4 for static.
    assert row["cost a / b"] == f"training {(2 - 0.3) / (1.2 * 0.4):.2f}"


def test_every_metric_says_which_way_is_better(results):
    table = next(t for t in all_tables(load_records(results)) if t.title.startswith("All metrics"))
    row = next(r for r in table.rows if r[:2] == ["4DGaussians + support against 4DGaussians", "whole frame"])
    cells = dict(zip(table.header, row, strict=True))
    assert cells["PSNR, dB"].startswith("+") and cells["PSNR, dB"].endswith(" win")
    assert cells["JOD"] == "+0.00 ± 0.00"
    if cells["FLIP"] != "–":
        assert cells["FLIP"].startswith("-") and cells["FLIP"].endswith(" win")


def test_one_metric_missing_leaves_a_dash_and_a_sentence(results, tmp_path):
    record = load_record(next(results.glob("*auto*.json")))
    for row in record.rows:
        for region in row.regions.values():
            region["flip"] = None
    record.missing = {"flip": "FLIP was not measured: flip-evaluator is not installed (requirements/bench.txt)."}
    record.pictures, record.two_instants, record.detailed = [], [], {}
    save_record(tmp_path, record)
    text = write_report(tmp_path, tmp_path / "report").read_text()
    assert record.missing["flip"] in text
    line = next(line for line in text.splitlines() if line.startswith("| **auto (ours)") or line.startswith("| auto"))
    assert "| – |" in line


def test_no_record_no_report(tmp_path):
    with pytest.raises(ValueError, match="nothing to report"):
        write_report(tmp_path, tmp_path / "report")


def test_report_contains_plots_strips_and_pictures(report):
    names = {p.name for p in report.glob("*.png")}
    assert {f"synthetic_{cost}.png" for cost in ("seconds", "frame_ms", "megabytes")} <= names
    for scene in ("room-3-exact", "ground-1-exact"):
        assert {f"{scene}_{what}.png" for what in ("methods", "worst", "two_instants")} <= names
    text = (report / "report.md").read_text()
    assert "bench &lt;quick&gt;" in text and "<quick>" not in text
    for name in re.findall(r"\]\(([^)]+)\)", text):
        assert (report / name).is_file()
