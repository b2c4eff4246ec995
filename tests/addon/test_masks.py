"""Masks on the panel: parameters passed to the solve, and a drawn mask rendered as pictures over the clip's frames."""

import json
import os
import subprocess
import sys
from pathlib import Path

import bpy
import numpy as np
import pytest

from tests.addon.data.pixels import read


@pytest.fixture
def drawn():
    """Mask of a rectangle in the left half of the picture."""
    mask = bpy.data.masks.new("people é")
    spline = mask.layers.new(name="one").splines.new()
    spline.use_cyclic = True
    spline.points.add(3)
    for point, (x, y) in zip(spline.points, ((0.05, 0.3), (0.35, 0.3), (0.35, 0.7), (0.05, 0.7)), strict=True):
        point.co = x, y
        point.handle_type = "VECTOR"
    return mask


def test_chosen_masks_reach_the_solve_request(addon, contract, scene, shot, tmp_path):
    props, step = scene.splannequin, addon("process.steps").STEPS["solve"]
    props.shot_path = str(shot)
    props.ignore_from, props.people_from = "FILE", "ALPHA"
    with pytest.raises(contract.JobError, match="Nothing is chosen for the mask Ignore"):
        step.params(scene)
    props.ignore_path = str(tmp_path / "x" / ".." / "logo.png")
    params = step.params(scene)
    assert (params.ignore_mask, params.people_mask) == (str(tmp_path / "logo.png"), "alpha")
    props.ignore_from = props.people_from = "NONE"
    assert step.params(scene) == contract.SolveParams(ignore_mask="")
    props.people_from = "DRAWN"
    with pytest.raises(contract.JobError, match="Nothing is chosen for the mask People"):
        step.params(scene)


def test_typed_focal_length_reaches_the_request_unchanged(addon, contract, scene):
    props, step = scene.splannequin, addon("process.steps").STEPS["solve"]
    props.sensor_mm, props.refine_focal = 23.6, False
    assert step.params(scene) == contract.SolveParams(), "without a focal length they say nothing"
    props.focal_mm = 24.3
    assert step.params(scene) == contract.SolveParams(focal_mm=24.3, sensor_mm=23.6, refine_focal=False)
    props.retry = False
    assert step.params(scene).retry is False


def test_a_drawn_mask_is_rendered_for_every_frame_and_leaves_nothing_in_the_file(addon, contract, scene, shot, drawn):
    props = scene.splannequin
    props.shot_path, props.people_from, props.people_drawn = str(shot), "DRAWN", drawn
    (shot / "masks" / "people").mkdir(parents=True)
    (shot / "masks" / "people" / "000099.png").write_bytes(b"of another range")
    before = {kind: len(getattr(bpy.data, kind)) for kind in ("scenes", "objects", "cameras", "node_groups", "images")}
    params = addon("process.steps").STEPS["solve"].params(scene)
    assert Path(params.people_mask) == shot / "masks" / "people"
    assert sorted(p.name for p in Path(params.people_mask).iterdir()) == ["000005.png", "000006.png", "000007.png"]
    found = read(shot / "masks" / "people" / "000006.png")[..., 0]
    listing = json.loads((shot / "frames" / "frames.json").read_text())
    assert found.shape == (listing["height"], listing["width"])
    height, width = found.shape
    inside = np.zeros(found.shape, bool)
    inside[round(0.45 * height) : round(0.55 * height), round(0.15 * width) : round(0.25 * width)] = True
    assert (found[inside] > 0.99).all() and (found[:, width // 2 :] < 0.1).all() and (found[0] < 0.1).all()
    assert {kind: len(getattr(bpy.data, kind)) for kind in before} == before
    assert bpy.context.scene == scene


@pytest.mark.parametrize("share", [1.0, 0.4])
def test_a_drawn_masks_values_are_those_of_its_picture(addon, shot, drawn, share):
    """The solve thresholds masks at 0.5. A view transform such as AgX would move values across this threshold."""
    drawn.layers[0].alpha = share
    found = read(addon("solve.drawn_masks").render(drawn, shot, "people") / "000006.png")[..., 0]
    height, width = found.shape
    inside = found[round(0.45 * height) : round(0.55 * height), round(0.15 * width) : round(0.25 * width)]
    assert np.allclose(inside, share, atol=0.01) and (found[:, width // 2 :] == 0.0).all()


def test_mask_renders_one_frame_per_tick_and_cancel_restores_the_scene(addon, shot, drawn):
    into = shot / "masks" / "people"
    into.mkdir(parents=True)
    (into / "000005.png").write_bytes(b"of before")
    scenes = list(bpy.data.scenes)
    turns = addon("solve.drawn_masks").in_turns(drawn.session_uid, drawn.name, shot, "people")
    assert next(turns) == (1, 3) and next(turns) == (2, 3)
    assert list(bpy.data.scenes) == scenes, "what it renders in is gone between two turns"
    turns.close()
    assert [p.name for p in into.parent.iterdir()] == ["people"]
    assert [(p.name, p.read_bytes()) for p in into.iterdir()] == [("000005.png", b"of before")]
    turns = addon("solve.drawn_masks").in_turns(drawn.session_uid, drawn.name, shot, "people")
    next(turns)
    bpy.data.masks.remove(drawn)
    with pytest.raises(addon("solve.drawn_masks").contract.JobError, match="The mask people é no longer exists"):
        next(turns)
    assert [(p.name, p.read_bytes()) for p in into.iterdir()] == [("000005.png", b"of before")]


def test_what_a_killed_blender_left_of_a_mask_is_removed_by_the_next_one_and_a_living_ones_stays(addon, shot, drawn):
    into, masks = shot / "masks" / "people", addon("solve.drawn_masks")
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        half, ours = (
            masks._temporary_folder(into, process.pid),
            masks._temporary_folder(into.with_name("ignore"), os.getpid()),
        )
        kept = [ours, into.with_name(".people"), into.with_name(".people-1")]
        for folder in (half, *kept):
            folder.mkdir(parents=True)
            (folder / "000005.png").write_bytes(b"half of all")
        masks.render(drawn, shot, "people")
        assert (half / "000005.png").is_file(), "it is at work"
        process.kill()
    masks.render(drawn, shot, "people")
    assert sorted(p for p in into.parent.iterdir()) == sorted([*kept, into])
    assert len(list(into.iterdir())) == 3


@pytest.fixture
def rendering(addon, scene, shot, drawn):
    """Watch of a shot whose masks the timer is rendering for a solve; the first frame is done."""
    timer = addon("process.job_timer")
    scene.splannequin.shot_path, scene.splannequin.people_from, scene.splannequin.people_drawn = (
        str(shot),
        "DRAWN",
        drawn,
    )
    timer.work(shot, "solve", addon("process.steps").STEPS["solve"].in_turns(scene, shot))
    timer.tick()
    watch = timer.watch_of(shot)
    assert not watch.failures and (watch.work.progress.done, watch.work.progress.total) == (1, 3)
    return watch


def test_masks_are_rendered_by_the_timer_and_then_the_solve_begins(addon, rendering, shot):
    for _ in range(2):
        addon("process.job_timer").tick()
    assert rendering.running() == "solve" and not rendering.jobs and not list((shot / "masks" / "people").iterdir())
    addon("process.job_timer").tick()
    assert not rendering.failures and rendering.work is None
    assert rendering.jobs["solve"].params["people_mask"] == str(shot / "masks" / "people")
    assert sorted(p.name for p in (shot / "masks" / "people").iterdir()) == ["000005.png", "000006.png", "000007.png"]
    rendering.jobs["solve"].process.kill()
    rendering.jobs["solve"].process.wait()


def test_a_solve_begins_though_its_scene_and_its_mask_are_renamed_meanwhile(addon, rendering, scene, drawn, shot):
    scene.name, drawn.name = "renamed", "renamed"
    for _ in range(3):
        addon("process.job_timer").tick()
    assert not rendering.failures and rendering.jobs["solve"].scene_uid == scene.session_uid
    assert len(list((shot / "masks" / "people").iterdir())) == 3
    rendering.jobs["solve"].process.kill()
    rendering.jobs["solve"].process.wait()


def test_rendering_masks_can_be_cancelled(rendering, shot):
    assert bpy.ops.splannequin.cancel(step="solve") == {"FINISHED"}
    assert rendering.running() is None and not rendering.failures and not rendering.jobs
    assert not list((shot / "masks" / "people").iterdir())


def test_no_solve_begins_for_another_shot_than_its_masks_are_of(addon, scene, rendering, tmp_path):
    scene.splannequin.shot_path = str(tmp_path / "other.splannequin")
    for _ in range(3):
        addon("process.job_timer").tick()
    assert "Another shot was chosen" in rendering.failures["solve"][0] and not rendering.jobs


def test_a_mask_follows_the_frames_that_its_clip_shows(addon, scene, shot, drawn, tmp_path, pictures):
    """Frame 5 of the shot is the first file of the sequence. The movie clip shows this file at scene frame 1."""
    for number in (5, 6, 7):
        pictures.write(tmp_path / f"take.{number:04d}.png", np.zeros((12, 16, 3), np.uint8))
    info = shot / "shot.json"
    info.write_text(json.dumps({**json.loads(info.read_text()), "source": str(tmp_path / "take.0005.png")}))
    shift = addon("solve.drawn_masks")._shift
    folder = addon("solve.drawn_masks").contract.ShotFolder(shot)
    assert shift(folder) == 0
    clip = bpy.data.movieclips.load(str(tmp_path / "take.0005.png"))
    assert shift(folder) == -4
    clip.frame_start = 5
    assert shift(folder) == 0


@pytest.mark.parametrize("how", ["moved", "linked"])
def test_a_mask_follows_its_clip_wherever_the_project_lies(addon, scene, shot, tmp_path, pictures, how):
    """shot.json stores the path of the footage at import; the artist opened it in Blender under another path."""
    plates = tmp_path / "project" / "plates"
    plates.mkdir(parents=True)
    for number in (1001, 1002):
        pictures.write(plates / f"take.{number}.png", np.zeros((12, 16, 3), np.uint8))
    named = "/old/place/plates/take.1001.png" if how == "moved" else str(plates / "take.1001.png")
    info, listing = shot / "shot.json", shot / "frames" / "frames.json"
    info.write_text(json.dumps({**json.loads(info.read_text()), "source": named}))
    relative_path = os.path.relpath(plates / "take.1001.png", shot)
    listing.write_text(json.dumps({**json.loads(listing.read_text()), "beside": relative_path}))
    opened = plates / "take.1001.png"
    if how == "linked":
        (tmp_path / "link").symlink_to(tmp_path / "project")
        opened = tmp_path / "link" / "plates" / "take.1001.png"
    bpy.data.movieclips.load(str(opened))
    assert addon("solve.drawn_masks")._shift(addon("solve.drawn_masks").contract.ShotFolder(shot)) == -1000


def test_mask_follows_its_clip_in_a_shot_with_a_start_frame(addon, shot, tmp_path, pictures):
    """File 0005 is frame 1005 of the shot. A clip that starts there shows it at scene frame 1."""
    for number in (5, 6):
        pictures.write(tmp_path / f"take.{number:04d}.png", np.zeros((12, 16, 3), np.uint8))
    info, listing = shot / "shot.json", shot / "frames" / "frames.json"
    info.write_text(json.dumps({**json.loads(info.read_text()), "source": str(tmp_path / "take.0005.png")}))
    listing.write_text(json.dumps({**json.loads(listing.read_text()), "shift": 1000}))
    bpy.data.movieclips.load(str(tmp_path / "take.0006.png"))
    assert addon("solve.drawn_masks")._shift(addon("solve.drawn_masks").contract.ShotFolder(shot)) == 1 - 1006


def test_of_two_sequences_in_a_folder_a_mask_follows_the_one_that_was_imported(addon, shot, tmp_path, pictures):
    for name in ("a.0001.png", "b.1001.png"):
        pictures.write(tmp_path / name, np.zeros((12, 16, 3), np.uint8))
        bpy.data.movieclips.load(str(tmp_path / name))
    info = shot / "shot.json"
    info.write_text(json.dumps({**json.loads(info.read_text()), "source": str(tmp_path / "b.1001.png")}))
    assert addon("solve.drawn_masks")._shift(addon("solve.drawn_masks").contract.ShotFolder(shot)) == -1000


def test_what_the_import_finds_to_be_burnt_in_is_ignored_unless_the_artist_says_otherwise(addon, contract, scene, shot):
    props, step = scene.splannequin, addon("process.steps").STEPS["solve"]
    props.shot_path = str(shot)
    assert props.ignore_from == "FOUND" and step.params(scene).ignore_mask == contract.MASK_FOUND
    try:
        props.ignore_from = "NONE"
        assert step.params(scene).ignore_mask == ""
        with pytest.raises(TypeError, match="FOUND"):
            props.people_from = "FOUND"
    finally:
        props.property_unset("ignore_from")


def test_a_drawn_mask_is_rendered_into_a_folder_with_braces_in_its_name(addon, shot, drawn):
    shot = shot.rename(shot.with_name("{show} {{x}}.splannequin"))
    folder = addon("solve.drawn_masks").render(drawn, shot, "people")
    assert folder == shot / "masks" / "people"
    assert sorted(p.name for p in folder.iterdir()) == ["000005.png", "000006.png", "000007.png"]
