"""Scenes of kind `held`: changes that happen once, the region in another state, and motion blur. Seed 0 of `tiny`."""

from __future__ import annotations

import importlib.util
import itertools
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

if importlib.util.find_spec("anny") is None:
    pytest.skip("anny is not installed (requirements/bench.txt)", allow_module_level=True)

from benchmarks.synthetic import make
from benchmarks.synthetic.cameras import intrinsics
from benchmarks.synthetic.generate import SHUTTER_FRAMES, SUBFRAMES, write_geometry
from benchmarks.synthetic.held import CAST, ROLES, change_times
from benchmarks.synthetic.people import Bodies
from benchmarks.synthetic.regions import Geometry, View, held_change_mask, region_maps, views_of
from benchmarks.synthetic.sizes import HELD, OBJECT_PREFIX, SIZES
from torch_backend.footage.images import read_png
from torch_backend.shot import write_json

TINY, SEED, FINER = SIZES["tiny"], 0, 4


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory) -> Path:
    """Folder with the geometry."""
    folder = tmp_path_factory.mktemp("held")
    write_geometry(folder, SEED, HELD, TINY, "", Bodies(TINY.texture_step))
    return folder


def maps(folder: Path, time: int, pose: int, window: int = 1) -> dict[str, np.ndarray]:
    """Masks of the things at a frame from another frame's camera, and the region `held`, at `FINER` times `tiny`'s
    size."""
    geometry, views = Geometry.load(folder), views_of(SEED, TINY, HELD)
    width, height = FINER * TINY.width, FINER * TINY.height
    frame_view, pose_view = (View(views[n].matrix, intrinsics(width, height), width, height) for n in (time, pose))
    found = region_maps(geometry, geometry.at(time), time, pose_view, frame_view)
    return found | {OBJECT_PREFIX + HELD: held_change_mask(geometry, geometry.at, time, pose, pose_view, window)}


def test_changing_object_is_static_before_and_after_its_change(scene_folder):
    """Seed 0 of `tiny`: an arm and a hand change between frames 2 and 6, a person leaves between frames 0 and 8."""
    plan = json.loads((scene_folder / "plan.json").read_text())
    assert [each["name"] for each in plan[HELD]] == list(CAST[SEED])
    geometry = Geometry.load(scene_folder)
    for each in plan[HELD]:
        vertices = np.load(scene_folder / "geometry" / f"{each['mover']}.npy")
        its = np.unique(geometry.triangles[geometry.objects[each["name"]]]) - len(geometry.static)
        begin, end = int(each["begin"] * TINY.fps), int(np.ceil(each["end"] * TINY.fps))
        assert begin < end < TINY.t_star_indices()[0] + 1

        def moved(a: int, b: int, its=its) -> np.ndarray:
            return np.linalg.norm(geometry.moving[b][its] - geometry.moving[a][its], axis=1)

        assert np.quantile(moved(end, TINY.frames - 1), 0.95) < 0.04 < np.median(moved(begin, end)) / 2
        assert vertices.shape[0] == TINY.frames


def test_held_region_is_where_a_static_plate_differs(scene_folder):
    """t* is 8, after every change; the poses are 0 (before) and 10 (after)."""
    before, after = (maps(scene_folder, 8, pose, window=0) for pose in (0, 10))
    assert set(CAST[SEED]) | {HELD} == {
        name.removeprefix(OBJECT_PREFIX) for name in before if name.startswith(OBJECT_PREFIX)
    }
    assert not after[OBJECT_PREFIX + HELD].any()
    region, arm = before[OBJECT_PREFIX + HELD], before[OBJECT_PREFIX + "raised"]
    assert region[arm].mean() > 0.6  # the plate shows the panel there, because the arm was down
    left = maps(scene_folder, 0, 0)[OBJECT_PREFIX + "leaving"]  # area of the person who has left by t* 8, in the plate
    assert left.sum() > 300 and region[left].mean() > 0.8 and not before[OBJECT_PREFIX + "leaving"][left].any()
    # She starts to walk at once: if neighbouring frames are considered, her pixels count as moving.
    assert maps(scene_folder, 8, 0)[OBJECT_PREFIX + HELD][left].mean() < 0.1
    assert region.sum() < 2.5 * (arm | left | before[OBJECT_PREFIX + "resting"]).sum()


def test_held_region_excludes_objects_during_their_change(scene_folder):
    """At frame 4 the arm and the hand move and a person walks, which flow detects."""
    region, shown = maps(scene_folder, 8, 4)[OBJECT_PREFIX + HELD], maps(scene_folder, 4, 4)
    for name in CAST[SEED]:
        assert shown[OBJECT_PREFIX + name].sum() > 50 and region[shown[OBJECT_PREFIX + name]].mean() < 0.15


def test_frames_have_motion_blur_and_the_truth_only_that_of_the_camera(scene_folder):
    plan = json.loads((scene_folder / "plan.json").read_text())
    for job in plan["jobs"]:
        times, views = ([moment[name] for moment in job["shutter"]] for name in ("time", "world_to_camera"))
        pose = int(Path(job["out"]).stem) - 1
        assert len(times) == (1 if "box" in job else SUBFRAMES) and all(views[0] != view for view in views[1:])
        if job["out"].startswith("truth/"):
            assert set(times) == {8.0}
        elif 0 < pose < TINY.frames - 1:
            assert max(times) - min(times) == pytest.approx(SHUTTER_FRAMES * (1 - 1 / SUBFRAMES))
            assert np.mean(times) == pytest.approx(pose)
    elsewhen = {name: time for job in plan["jobs"] for name, time in job.get("elsewhen", {}).items()}
    assert set(elsewhen) == {"person0", "person1", "person2"} and max(elsewhen.values()) < 8.0


@pytest.mark.parametrize("size", ["quick", "medium", "delivery"])
def test_every_change_is_over_before_the_next_instant(size):
    instants = [index / SIZES[size].fps for index in SIZES[size].t_star_indices()]
    for role, seed in itertools.product(ROLES, range(20)):
        begin, end = change_times(SIZES[size], role, np.random.default_rng(seed))
        before = max(t for t in instants if t < end)
        assert begin - before > 0.35 and min(t for t in instants if t > begin) - end > 0.35


def test_the_cast_has_every_role_and_no_head_turns_where_no_column_hides_it():
    assert all(len(set(roles)) == 3 for roles in CAST) and set().union(*CAST) == set(ROLES)
    assert set().union(*CAST[3:9]) == set(ROLES)  # the seeds that reports accept
    assert all(seed % 4 in (2, 3) for seed in range(10) if "turned" in CAST[seed])


def test_truth_background_shows_the_second_state(scene_folder, tmp_path):
    """In rendered pictures: at t* 8 a person has left; the other picture shows her at her former place."""
    folder = tmp_path / "rendered"
    shutil.copytree(scene_folder, folder)
    plan = json.loads((folder / "plan.json").read_text())
    wanted = ("truth/000009/000009.png", "truth/000009/behind/000009.png", "frames/000009.png")
    jobs = [next(job for job in plan["jobs"] if job["out"] == out) for out in wanted]
    write_json(folder / "plan.json", {**plan, "jobs": jobs, "oversize": 1})
    write_json(folder / "meter.json", {"stops": 0.0, "bpy": "", "threads": 0})
    make._render(folder, make.find_bpy(None), lambda text: None)
    truth, behind, frame = (read_png(folder / out).astype(float) for out in wanted)
    geometry, view = Geometry.load(scene_folder), views_of(SEED, TINY, HELD)[8]
    left = region_maps(geometry, geometry.at(0), 0, view, view)[OBJECT_PREFIX + "leaving"]
    left[:, :] &= behind.sum(axis=2) > 0  # inside the box
    assert left.sum() > 20
    assert np.abs(truth - behind).mean(axis=2)[left].mean() > 20
    assert np.abs(truth - frame).mean() < 1.0  # nothing changes at t* except sway
