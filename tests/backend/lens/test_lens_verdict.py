"""Plausible, doubtful and refused lenses; a known focal length; a fisheye."""

import json
import math

import numpy as np
import pytest

from torch_backend.contract import ExitCode, JobError
from torch_backend.lens.lens_verdict import angle_deg, doubt_of, impossible, lens_remarks, refuse_lens
from torch_backend.sfm.child import run_worker

FISHEYE = "OPENCV_FISHEYE"
MIDDLE = 320.0, 240.0


def radial(focal, k):
    return "SIMPLE_RADIAL", 640, 480, (focal, *MIDDLE, k)


def fisheye(focal, *k):
    return FISHEYE, 640, 480, (focal, focal, *MIDDLE, *[*k, 0.0, 0.0, 0.0, 0.0][:4])


def test_a_fisheye_is_as_wide_as_its_angles_and_not_as_a_pinhole_s():
    assert angle_deg(*fisheye(320.0)) == pytest.approx(math.degrees(2.0), abs=0.2)
    assert angle_deg(*radial(320.0, 0.0)) == pytest.approx(90.0)
    assert angle_deg(*fisheye(60.0)) > 300 and angle_deg(*fisheye(250.0, -0.5)) == 360.0


@pytest.mark.parametrize(
    ("lens", "expected"),
    [
        (radial(600.0, 0.05), ""),
        (radial(600.0, -0.3), ""),
        (radial(600.0, 1.2), "strong"),
        (radial(600.0, -1.2), "strong"),
        (radial(300.0, -0.4), "folded"),
        (fisheye(260.0, 0.02, -0.006), ""),
        (fisheye(260.0, -0.4), "folded"),
        (fisheye(260.0, 1.3), "strong"),
        # The picture of a circular fisheye ends before the corners, and its curve may end there too.
        (fisheye(300.0, -0.1), ""),
    ],
)
def test_bends_that_no_camera_has(lens, expected):
    assert impossible(*lens) == expected
    assert bool(doubt_of(*lens)) == bool(expected)


def test_known_focal_length_is_doubted_only_if_the_solve_diverged_from_it():
    narrow = radial(9000.0, 0.0)
    assert doubt_of(*narrow) == "narrow" and doubt_of(*narrow, 8000.0) == ""
    assert doubt_of(*radial(600.0, 0.0), 800.0) == "off" and doubt_of(*radial(600.0, 0.0), 700.0) == ""


def answer(focal=600.0, **lens):
    lens_facts = {"doubt": "", "held": False, "found_px": focal, "width": 640, "height": 480, **lens}
    return {"focal_px": focal, "distortion": [4.08], "lens": lens_facts}


@pytest.mark.parametrize(
    ("solve", "words"),
    [
        (answer(5000.0), "7.3 degrees wide (5000 px)"),
        (answer(80.0), "151.9 degrees wide (80 px)"),
        (answer(300.0, view_deg=152.0), "152.0 degrees wide (300 px)"),
        (answer(impossible="folded"), "it folds the picture over before its corners (4.08)"),
        (
            answer(impossible="folded", doubt="bent", found_bend=-0.4),
            "it folds the picture over before its corners (4.08)",
        ),
        (answer(impossible="strong"), "its distortion is far too strong (4.08)"),
    ],
)
def test_a_lens_that_no_camera_has_is_refused_in_one_sentence(solve, words):
    with pytest.raises(JobError) as error:
        refuse_lens(solve)
    assert error.value.message == f"The solve found an impossible lens: {words}."
    assert error.value.exit_code == ExitCode.SOLVE
    assert error.value.hint.startswith("If the lens is a fisheye") == (
        "found_bend" in solve["lens"] or "view_deg" in solve["lens"]
    )


def test_plausible_and_user_supplied_lenses_pass():
    for solve in (answer(), answer(80.0, view_deg=140.0), answer(5000.0, given_px=5000.0)):
        refuse_lens(solve)


def test_fixed_or_refined_focal_length_is_reported():
    kept_focal = lens_remarks(answer(800.0, held=True, doubt="off", found_px=1200.0, given_px=800.0))
    assert kept_focal[0][0].endswith("(1200 px instead of 800), but it is kept fixed.")
    left = lens_remarks(answer(1200.0, doubt="off", given_px=800.0))
    assert left[0][0] == "The solved focal length is 1200 px, but 800 px was set."


def solved(folder, tools, pictures, **request):
    """(answer, poses by picture) of COLMAP alone, without undistorted frames and mattes."""
    request_facts, _ = tools.request_for(folder, pictures, **request)
    names = request_facts["solved"]
    (folder / "request.json").write_text(json.dumps(request_facts))
    found = run_worker(folder / "request.json", folder / "log.txt", tools.recorder())["result"]
    poses = json.loads((folder / "poses.json").read_text())
    return found, [np.array(poses[name]["pose"]) for name in names if name in poses]


def test_fixed_focal_length_stays_exact(tmp_path, tools):
    pictures = [tools.room().render(pose, (300.0, 300.0, 160.0, 120.0), -0.06) for pose in tools.handheld(8)]
    found, poses = solved(tmp_path, tools, pictures, focal_px=306.0, hold_focal=True, features=500)
    assert len(poses) == 8 and found["focal_px"] == 306.0 and found["lens"]["given_px"] == 306.0
    assert found["distortion"] == [pytest.approx(-0.06, abs=0.02)]


def test_file_focal_length_is_used_if_the_clip_gives_none(tmp_path, tools):
    """A wall seen frontally is ambiguous: far through a long lens looks like near through a short one. The user gave no
    focal length, but the file has one."""
    poses = [tools.look([-0.5 + 0.1 * i, -0.4, 3.6 + 0.02 * i]) for i in range(8)]
    pictures = [tools.room().render(pose, (300.0, 300.0, 160.0, 120.0), -0.06) for pose in poses]
    found, _ = solved(tmp_path, tools, pictures, start_focal_px=310.0)
    assert found["focal_px"] == 310.0 and found["lens"]["held"] and not found["lens"]["given_px"]
    ((said, _),) = lens_remarks(found)
    assert said.endswith("the lens stated in the file is used, 55 degrees wide.")
