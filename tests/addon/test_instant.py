"""t* in the panel: it starts at the current frame and stays within the clip; a take of another instant is not done."""

import json

import bpy
import pytest


@pytest.fixture
def with_shot(scene, shot, addon):
    """Scene with the shot of frames 5 to 7, as after an import."""
    scene.splannequin.shot_path = str(shot)
    return scene


def change(path, **more):
    path.write_text(json.dumps(json.loads(path.read_text()) | more))


def view(addon, scene, shot, step="freeze"):
    return addon("process.steps").STEPS[step].view(scene, addon("shot.inventory").read(shot))


def test_ticking_t_star_takes_the_current_frame_not_frame_1(with_shot):
    with_shot.frame_set(7)
    with_shot.splannequin.choose_t_star = True
    assert with_shot.splannequin.t_star == 7


def test_ticking_t_star_keeps_an_instant_that_was_set(with_shot):
    with_shot.splannequin.t_star = 5
    with_shot.frame_set(7)
    with_shot.splannequin.choose_t_star = True
    assert with_shot.splannequin.t_star == 5


def test_the_second_shot_of_the_list_starts_at_its_current_frame_too(with_shot, shot):
    with_shot.splannequin.t_star = 5
    bpy.ops.splannequin.shot_add()
    with_shot.splannequin.shot_path = str(shot)
    with_shot.frame_set(6)
    with_shot.splannequin.choose_t_star = True
    assert with_shot.splannequin.t_star == 6


@pytest.mark.parametrize(("requested", "clamped"), [(411, 7), (-3, 5), (6, 6)])
def test_t_star_is_clamped_to_the_clip(with_shot, requested, clamped):
    with_shot.splannequin.t_star = requested
    assert with_shot.splannequin.t_star == clamped


def test_a_take_is_done_while_it_is_what_freeze_would_make_now(addon, with_shot, shot):
    facts, props = shot / "takes" / "freeze" / "take.json", with_shot.splannequin
    assert view(addon, with_shot, shot).done
    change(facts, frames_in_all=30)
    assert not view(addon, with_shot, shot).done, "3 of its 30 frames are there"
    change(facts, frames_in_all=3, t_star_asked=7)
    assert view(addon, with_shot, shot).done
    props.t_star, props.choose_t_star = 5, True
    assert not view(addon, with_shot, shot).done, "its t* is 6"
    props.t_star = 7
    assert view(addon, with_shot, shot).done, "7 was asked for, 6 is the nearest that was trained"
    with_shot.keyframe_insert("splannequin.t_star", frame=5)
    assert not view(addon, with_shot, shot).done, "t* is keyed now"
    change(facts, t_star_per_frame={"5": 7.0, "6": 7.0, "7": 7.0})
    assert view(addon, with_shot, shot).done
    props.overscan = "LENS"
    assert not view(addon, with_shot, shot).done


def test_a_take_of_the_clips_move_is_not_done_for_a_camera_of_the_artists(addon, with_shot, shot):
    camera = bpy.data.objects.new("own", bpy.data.cameras.new("own"))
    with_shot.collection.objects.link(camera)
    with_shot.splannequin.path_camera = camera
    assert not view(addon, with_shot, shot).done
    with_shot.splannequin.take_name = "another"
    assert "camera" in view(addon, with_shot, shot).advice and "clip" not in view(addon, with_shot, shot).advice


def test_overscan_percentage_reaches_the_request(addon, with_shot):
    props, params = with_shot.splannequin, addon("freeze.takes").params_of
    props.overscan_percent = 12.5
    assert params(with_shot).overscan == 0.0
    props.overscan = "PERCENT"
    assert params(with_shot).overscan == 12.5


@pytest.mark.parametrize(
    ("places", "called"),
    [
        (("a/shot", "b/shot"), ["shot (a)", "shot (b)"]),
        (("x/m/shot", "y/m/shot", "z/other"), ["shot (x/m)", "shot (y/m)", "other"]),
        (("a/shot", "b/other"), ["shot", "other"]),
    ],
)
def test_shots_with_the_same_name_have_distinct_list_entries(addon, scene, tmp_path, places, called):
    for n, place in enumerate(places):
        if n:
            bpy.ops.splannequin.shot_add()
        scene.splannequin.shot_path = str(tmp_path / f"{place}.splannequin")
    assert addon("shot.selection").labels(scene) == called


def test_a_freeze_that_has_ended_is_seen_through_the_solved_camera(addon, contract, with_shot, shot, previews):
    previews(shot)
    bpy.ops.splannequin.load_camera()
    camera = with_shot.camera
    (plate,) = camera.data.background_images
    job = addon("process.jobs").new_job(shot, "freeze", contract.FreezeParams(take="freeze"))
    job.result = {"take": "freeze", "t_star_frame": 6, "first": 5, "last": 7, "camera_path": "elsewhere.json"}
    step = addon("process.steps").STEPS["freeze"]
    assert step.finish(with_shot, job) == [] and plate.show_background_image, "it is another camera's view"
    job.result["camera_path"] = ""
    for _ in range(2):  # twice: the shot is frozen again
        assert len(step.finish(with_shot, job)) == 1
        plate, frozen = camera.data.background_images
        assert not plate.show_background_image and frozen.show_background_image
        assert bpy.path.abspath(frozen.image.filepath).endswith("000005.png")
        assert (frozen.image_user.frame_start, frozen.image_user.frame_duration) == (5, 3)
    assert addon("solve.cameras").find(with_shot, shot, "MESH").hide_get()
    bpy.ops.splannequin.remove_shot()
    assert not [image for image in bpy.data.images if image.name.startswith("Frozen")]
