"""The synthetic benchmark, with the real body model and a real bpy: one tiny scene, made once."""

from __future__ import annotations

import importlib.util
import itertools
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

if importlib.util.find_spec("anny") is None:
    pytest.skip("anny is not installed (requirements/bench.txt)", allow_module_level=True)

from benchmarks.synthetic import make
from benchmarks.synthetic.__main__ import main
from benchmarks.synthetic.folder import SyntheticScene
from benchmarks.synthetic.generate import EXPOSURE_RAMP_STOPS, SHUTTER_SECONDS, write_geometry
from benchmarks.synthetic.people import Bodies
from benchmarks.synthetic.shot import (
    SolvedPixels,
    exact_cameras,
    exact_shot,
    import_clip,
    similarity_to_exact,
    surface_points,
)
from benchmarks.synthetic.sizes import KINDS, REPORT_SEEDS, SIZES, TUNING_SEEDS
from torch_backend.contract import CameraFrame, CameraPath, read_json
from torch_backend.scene import load_scene
from torch_backend.shot import write_json

ROOT = Path(__file__).resolve().parents[2]
TINY = SIZES["tiny"]
SEED = 0


class Silent:
    def progress(self, stage, done, total, message=""):
        pass

    def metric(self, stage, values):
        pass

    def image(self, label, path):
        pass

    def warning(self, message, hint=""):
        pass

    def check_cancelled(self):
        pass


@pytest.fixture(scope="session")
def bodies() -> Bodies:
    return Bodies(TINY.texture_step)


@pytest.fixture(scope="session")
def out(tmp_path_factory, bodies) -> Path:
    folder = tmp_path_factory.mktemp("synthetic")
    make.make_scene(folder, TINY, SEED, "plain", make.find_bpy(None), lambda: bodies, lambda text: None)
    return folder


@pytest.fixture(scope="session")
def scene(out) -> SyntheticScene:
    return SyntheticScene.load(out / "tiny" / f"seed-{SEED:03d}")


def contents(folder: Path, *parts: str) -> dict[str, bytes]:
    files = [p for part in parts for p in sorted((folder / part).rglob("*")) if p.is_file()]
    return {str(p.relative_to(folder)): p.read_bytes() for p in files}


def project(scene: SyntheticScene, frame: int, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    local = points @ scene.world_to_camera[frame][:3, :3].T + scene.world_to_camera[frame][:3, 3]
    return local[:, :2] / local[:, 2:] * scene.K[[0, 1], [0, 1]] + scene.K[:2, 2], local[:, 2]


def unproject(scene: SyntheticScene, frame: int, depth: np.ndarray) -> np.ndarray:
    """[H*W, 3] world points of the pixel centres at planar depths [H, W]."""
    x, y = np.meshgrid(np.arange(scene.width) + 0.5, np.arange(scene.height) + 0.5)
    rays = np.stack([(x - scene.K[0, 2]) / scene.K[0, 0], (y - scene.K[1, 2]) / scene.K[1, 1], np.ones_like(x)], -1)
    matrix = scene.world_to_camera[frame]
    return ((rays * depth[..., None]).reshape(-1, 3) - matrix[:3, 3]) @ matrix[:3, :3]


def test_same_seed_gives_the_same_bytes(out, scene, bodies, tmp_path):
    key = read_json(scene.root / "plan.json")["key"]
    write_geometry(tmp_path, SEED, "plain", TINY, key, bodies)
    again, first = contents(tmp_path, "."), contents(scene.root, "geometry", "textures")
    first["plan.json"] = (scene.root / "plan.json").read_bytes()
    assert {k: v == again[k] for k, v in first.items()} == dict.fromkeys(again, True)


def test_another_seed_gives_another_scene(scene, bodies, tmp_path):
    write_geometry(tmp_path, SEED + 1, "plain", TINY, "", bodies)
    a, b = read_json(scene.root / "plan.json"), read_json(tmp_path / "plan.json")
    assert a["people"] != b["people"]
    assert a["jobs"][0]["bands"][0]["world_to_camera"] != b["jobs"][0]["bands"][0]["world_to_camera"]


def test_a_scene_is_whole(scene):
    assert scene.frames == list(range(1, 13)) and scene.t_stars == [9] and scene.poses == [1, 5, 9]
    pictures = [scene.frame(f) for f in scene.frames] + [scene.truth(9, p) for p in scene.poses]
    for picture in pictures:
        assert picture.shape == (54, 96, 3) and picture.dtype == np.uint8
        assert 50 < picture.mean() < 200 and picture.std() > 25  # neither black nor bare
    changed = [np.abs(a.astype(float) - b).mean() for a, b in itertools.pairwise(pictures[:12])]
    assert min(changed) > 1.0  # the camera moves in every frame


def test_camera_stays_inside_the_room_and_people_stand_on_the_floor(scene):
    static = np.load(scene.root / "geometry" / "static.npz")["vertices"]
    low, high = static.min(axis=0), static.max(axis=0)
    centres = scene.centres()
    assert (centres > low + 0.3).all() and (centres < high - 0.3).all()
    assert np.linalg.norm(centres[-1] - centres[0]) > 1.0
    for path in (scene.root / "geometry").glob("person*.npy"):
        vertices = np.load(path)
        assert np.abs(vertices[..., 2].min(axis=1)).max() < 0.02
        assert 0.7 < np.ptp(vertices[0, :, 2]) < 2.2
        drift = np.linalg.norm(vertices - vertices[:1], axis=2).max(axis=0)
        assert 0.003 < drift.max() < 0.35 and np.median(drift) < 0.08  # still, but not frozen


def test_truth_at_the_pose_of_its_own_instant_is_the_clips_frame(scene):
    assert (scene.truth(9, 9) == scene.frame(9)).all()
    regions = scene.regions(9, 9)
    assert regions.seen.all()
    assert (regions.depth == scene.frame_depth(9)).all() and (regions.moving == scene.frame_moving(9)).all()


@pytest.mark.parametrize("pose", [1, 5])
def test_seen_pixels_are_where_the_frozen_frame_shows_them(scene, pose):
    regions, own = scene.regions(9, pose), scene.frame_depth(9)
    points = unproject(scene, pose, regions.depth)
    pixels, depth = project(scene, 9, points)
    column, row = np.floor(pixels).astype(int).T
    inside = (depth > 0) & (column >= 0) & (row >= 0) & (column < scene.width) & (row < scene.height)
    seen = regions.seen.ravel()
    assert not seen[~inside].any()
    # Against the frame's own depths: the nearest of the 3x3 around, for a pixel is not a point.
    padded = np.pad(own, 1, mode="edge")
    around = np.stack([padded[1 + row[inside] + i, 1 + column[inside] + j] for i in (-1, 0, 1) for j in (-1, 0, 1)])
    off = np.abs(around - depth[inside]).min(axis=0) / depth[inside]
    hidden = around.min(axis=0) < depth[inside] - 0.01
    assert (off[seen[inside]] < 0.02).mean() > 0.99
    assert hidden[~seen[inside]].mean() > 0.95
    assert 0.2 < seen.mean() < 1.0


@pytest.mark.parametrize("pose", [1, 5])
def test_cameras_depths_and_pictures_belong_together(scene, pose):
    """The frame of t*, looked up through the truth's depth, is the truth; half a step aside it is not."""
    regions, frame, truth = scene.regions(9, pose), scene.frame(9).astype(float), scene.truth(9, pose).astype(float)
    pixels, _ = project(scene, 9, unproject(scene, pose, regions.depth))
    seen = regions.seen.ravel()

    def error(shift: float) -> float:
        column = np.clip(np.floor(pixels[:, 0] + shift).astype(int), 0, scene.width - 1)
        row = np.clip(np.floor(pixels[:, 1]).astype(int), 0, scene.height - 1)
        return float(np.median(np.abs(frame[row, column] - truth.reshape(-1, 3)).mean(axis=1)[seen]))

    assert error(0.0) < 0.75 * min(error(-2.0), error(2.0))


def test_what_moves_are_people_and_what_stands_is_still(scene):
    moving = scene.frame_moving(9)
    assert 0.005 < moving.mean() < 0.5
    static = np.load(scene.root / "geometry" / "static.npz")["vertices"]
    points = unproject(scene, 9, scene.frame_depth(9))
    people = np.concatenate([np.load(p)[8] for p in (scene.root / "geometry").glob("person*.npy")])
    from scipy.spatial import cKDTree

    near_people = cKDTree(people).query(points)[0].reshape(moving.shape) < 0.05
    assert near_people[moving].all()
    assert len(static) > 1000


def run_cli(out: Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-P", "-m", "benchmarks.synthetic", "--size", "tiny", "--seeds", str(SEED)]
    command += ["--out", str(out)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.Popen(
        command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def test_killed_twice_it_goes_on_to_the_same_pictures(out, scene, tmp_path):
    copy = tmp_path / "tiny" / scene.root.name
    shutil.copytree(scene.root, copy)
    (copy / "scene.json").unlink()
    for path in [*sorted((copy / "frames").glob("*.png"))[4:], *(copy / "truth").rglob("*.npz")]:
        path.unlink()
    missing = {p for p in scene.root.rglob("*.png") if not (copy / p.relative_to(scene.root)).exists()}
    assert len(missing) == 8
    for wanted in (5, 7):
        process = run_cli(tmp_path)
        deadline = time.monotonic() + 300
        while len(list((copy / "frames").glob("0*.png"))) < wanted and time.monotonic() < deadline:
            assert process.poll() is None, process.communicate()
            time.sleep(0.02)
        process.kill()
        process.communicate()
        assert not (copy / "scene.json").exists()
    process = run_cli(tmp_path)
    _, problem = process.communicate()
    assert process.returncode == 0, problem
    parts = ("frames", "truth", "masks")
    before = contents(scene.root, *parts)
    after = {name: data for name, data in contents(copy, *parts).items() if not Path(name).name.startswith(".")}
    assert {k: v == before[k] for k, v in after.items()} == dict.fromkeys(before, True)
    assert "already there" in run_cli(tmp_path).communicate()[0]


def test_what_an_older_generator_made_is_refused(out, scene, tmp_path, capfd):
    copy = tmp_path / "tiny" / scene.root.name
    copy.mkdir(parents=True)
    write_json(copy / "scene.json", {**scene.info, "key": "another"})
    assert main(["--size", "tiny", "--seeds", str(SEED), "--out", str(tmp_path)]) == 1
    assert "another version of the generator" in capfd.readouterr().err
    write_json(copy / "scene.json", {**scene.info, "version": 99})
    with pytest.raises(ValueError, match="format version 99"):
        SyntheticScene.load(copy)
    with pytest.raises(FileNotFoundError, match="no scene.json"):
        SyntheticScene.load(tmp_path)


def test_without_a_bpy_one_sentence_says_what_to_do(tmp_path, capfd):
    assert main(["--size", "tiny", "--out", str(tmp_path), "--bpy", str(tmp_path / "nowhere")]) == 1
    assert "python3 splannequin.py setup" in capfd.readouterr().err


@pytest.mark.parametrize("kind", KINDS)
def test_each_limit_breaks_what_it_says(kind, bodies, tmp_path):
    write_geometry(tmp_path, SEED, kind, TINY, "", bodies)
    plan = json.loads((tmp_path / "plan.json").read_text())
    clip = [job for job in plan["jobs"] if job["out"].startswith("frames/")]
    truth = [job for job in plan["jobs"] if job["out"].startswith("truth/")]
    ramp = clip[-1]["stops"] - clip[0]["stops"]
    assert ramp == pytest.approx(EXPOSURE_RAMP_STOPS if kind == "exposure-ramp" else 0.0)
    assert {job["stops"] for job in truth} == {clip[8]["stops"]}
    hidden = [m["name"] for m in plan["movers"] if not m["in_view"]]
    assert hidden == (["board"] if kind == "moving-shadow" else [])
    times = [band["time"] for band in clip[5]["bands"]]
    spread = (times[-1] - times[0]) / TINY.fps
    assert all(len(job["bands"]) == 1 for job in truth)
    if kind == "rolling-shutter":
        assert np.mean(times) == pytest.approx(5.0) and 0.8 * SHUTTER_SECONDS < spread < SHUTTER_SECONDS
        assert clip[5]["bands"][0]["rows"][0] == 0 and clip[5]["bands"][-1]["rows"][1] == TINY.height
    else:
        assert times == [5.0]
    fastest = 0.0
    for mover in plan["movers"]:
        if mover["in_view"]:
            vertices = np.load(tmp_path / "geometry" / f"{mover['name']}.npy")
            fastest = max(fastest, float(np.linalg.norm(np.diff(vertices, axis=0), axis=2).max()) * TINY.fps)
    assert (fastest > 2.0) == (kind in ("fast-mover", "walker")) and (fastest == 0.0) == (kind == "still")
    views = np.array([job["bands"][0]["world_to_camera"] for job in clip])
    centres = -np.einsum("nji,nj->ni", views[:, :3, :3], views[:, :3, 3])
    assert (np.ptp(centres, axis=0).max() < 0.06) == (kind == "tripod"), "the camera travels"
    if kind == "walker":
        walker = np.load(tmp_path / "geometry" / "person0.npy")[..., 0].mean(axis=1)
        assert abs(walker[-1] - walker[0]) == pytest.approx(3.2, abs=0.2)
        assert (walker[-1] - walker[0]) * (centres[-1] - centres[0])[0] < 0, "against the camera"


def test_an_exact_shot_is_one_that_the_product_trains_on(scene, tmp_path):
    shot = exact_shot(scene, tmp_path / "exact.splannequin", Silent())
    loaded = load_scene(shot)
    assert loaded.frames == scene.frames and len(loaded.solved) == 12 and len(loaded.points) > 100
    centres = -np.einsum("nji,nj->ni", loaded.viewmats[:, :3, :3].numpy(), loaded.viewmats[:, :3, 3].numpy())
    assert np.abs(centres / loaded.scale + loaded.centre - scene.centres()).max() < 1e-4
    pixels, depth = project(scene, 1, loaded.points.numpy() / loaded.scale + loaded.centre)
    inside = (depth > 0) & (pixels > 0).all(axis=1) & (pixels < [scene.width, scene.height]).all(axis=1)
    assert inside.mean() > 0.3
    exact_shot(scene, tmp_path / "exact.splannequin", Silent())
    unchanged = SolvedPixels(shot)
    assert (unchanged.picture(scene.truth(9, 1)) == scene.truth(9, 1)).all()
    assert (unchanged.regions(scene.regions(9, 1)).seen == scene.regions(9, 1).seen).all()


def test_surface_points_lie_on_what_the_frames_see(scene):
    points = surface_points(scene)
    pixels, depth = project(scene, 1, points["xyz"][: len(points["xyz"]) // 6].astype(np.float64))
    column, row = np.clip(np.floor(pixels).astype(int), 0, [scene.width - 1, scene.height - 1]).T
    off = np.abs(scene.frame_depth(1)[row, column] - depth) / depth
    assert np.median(off) < 0.01


def test_the_similarity_leads_from_solved_cameras_to_exact_ones(scene, tmp_path):
    shot = import_clip(scene, tmp_path / "solved.splannequin", Silent())
    rng = np.random.default_rng(3)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    rotation *= np.linalg.det(rotation)
    scale, offset = 0.37, np.array([1.0, -2.0, 3.0])
    cameras = []
    for frame in scene.frames:
        # x_exact = scale R x + offset: the same camera in another world's units.
        matrix = scene.world_to_camera[frame].copy()
        matrix[:3, 3] = (matrix[:3, :3] @ offset + matrix[:3, 3]) / scale
        matrix[:3, :3] = matrix[:3, :3] @ rotation
        cameras.append(CameraFrame(frame, matrix.ravel().tolist(), [80.0, 80.0, 48.0, 27.0], "registered"))
    write_json(shot.solve / "cameras.json", CameraPath(scene.width, scene.height, cameras).to_json())
    found = similarity_to_exact(scene, shot)
    assert found.scale == pytest.approx(scale) and np.allclose(found.rotation, rotation)
    assert np.allclose(found.translation, offset) and found.rms < 1e-6 and found.rotation_error_deg < 1e-3
    for ours, theirs in zip(exact_cameras(scene, found).frames, cameras, strict=True):
        assert np.allclose(ours.viewmat, theirs.viewmat, atol=1e-5)


def test_no_seed_is_both_tuned_and_reported_on():
    assert not set(TUNING_SEEDS) & set(REPORT_SEEDS) and len(REPORT_SEEDS) >= 10
