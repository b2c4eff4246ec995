"""What answers each of the fifteen complaints (docs/blender.md), and the proof that its test needs the answer.

    python3 tests/addon/complaints.py --backend PYTHON --bpy PYTHON [WORD ...]

Takes one answer at a time out of a copy of the checkout, runs the test that stands for it, and expects it to fail.
`--bpy` is a Python with Blender's module and pytest, `--backend` one of the backend's environment. WORDs choose
answers by their text. Not part of the suite (ten minutes); `test_complaints.py` checks that the texts below are there.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
ADDON = "splannequin_addon/"


@dataclass(frozen=True)
class Answer:
    """One thing that can be taken out."""

    complaint: int
    """Row of the table in docs/blender.md."""
    what: str
    """The answer, in a few words."""
    file: str
    """Where it stands."""
    old: str
    """Its text, once in the file."""
    new: str
    """What stands there without it."""
    test: str
    """The test that then fails, as pytest names it."""


CAMERAS, COMPOSITOR = f"{ADDON}solve/cameras.py", f"{ADDON}bake/compositor.py"
TEST = "tests/addon/test_"
ANSWERS = (
    Answer(
        1,
        "the zip holds no wheels",
        "blender_manifest.toml",
        "[build]",
        'wheels = ["./wheels/torch-2.13.0-cp311-cp311-win_amd64.whl"]\n\n[build]',
        f"{TEST}package.py::test_source_and_zip_are_valid_and_hold_what_is_needed",
    ),
    Answer(
        2,
        "the artist's stream goes on through the group",
        f"{ADDON}bake/placing.py",
        '        tree.links.new(source, node.inputs["Image"])\n',
        "        pass\n",
        f"{TEST}compositor.py::test_artists_nodes_and_links_stay_identical",
    ),
    Answer(
        2,
        "a second bake updates the group",
        COMPOSITOR,
        "    if node is None:\n        node = freeze_group.new_node(tree, before)",
        "    if True:\n        node = freeze_group.new_node(tree, before)",
        f"{TEST}compositor.py::test_second_bake_updates_the_group",
    ),
    Answer(
        2,
        "removal leads the artist's link back",
        f"{ADDON}bake/placing.py",
        "            tree.links.new(sources[0], target)",
        "            pass",
        f"{TEST}compositor.py::test_removal_restores_the_tree",
    ),
    Answer(
        3,
        "a camera is read frame by frame",
        f"{ADDON}freeze/own_camera.py",
        "    scene.frame_set(number)\n",
        "",
        f"{TEST}cameras.py::test_an_artists_camera_is_read_in_solve_units",
    ),
    Answer(
        3,
        "t* is read frame by frame",
        f"{ADDON}freeze/takes.py",
        "float(curve.evaluate(n))",
        "float(curve.evaluate(low))",
        f"{TEST}cameras.py::test_a_keyed_instant_is_followed_frame_by_frame",
    ),
    Answer(
        4,
        "the nearer of CG and frozen shows",
        f"{ADDON}bake/group_inside.py",
        "    group.links.new(cg, ratio.inputs[0])\n    group.links.new(frozen, ratio.inputs[1])\n",
        "    group.links.new(frozen, ratio.inputs[0])\n    group.links.new(cg, ratio.inputs[1])\n",
        f"{TEST}compositor.py::test_cg_stands_in_front_and_behind_by_depth",
    ),
    Answer(
        4,
        "a rendered cube stands among the frozen",
        COMPOSITOR,
        'tree.links.new(layers.outputs["Depth"], node.inputs["CG Depth"])',
        "pass",
        f"{TEST}compositor.py::test_a_cube_is_hidden_by_what_is_nearer_and_hides_what_is_farther",
    ),
    Answer(
        5,
        "depth is 32-bit float",
        "torch_backend/contract/frame_layers.py",
        '("Z",),\n        "float",',
        '("Z",),\n        "half",',
        "tests/backend/freeze/test_exr.py::test_round_trip_keeps_depth_exact_and_the_rest_to_half",
    ),
    Answer(
        6,
        "the focal length is keyed",
        CAMERAS,
        "    if varies:\n",
        "    if False:\n",
        f"{TEST}cameras.py::test_lens_is_keyed_where_it_changes",
    ),
    Answer(
        6,
        "turns go the short way",
        CAMERAS,
        "            rotation.negate()\n",
        "            pass\n",
        f"{TEST}cameras.py::test_quaternions_take_the_short_way",
    ),
    Answer(
        7,
        "the original comes back out of the undistorted plate",
        "torch_backend/solve/stmap.py",
        "        at = _st(lens.to_plate(_centres(lens, width, height, top)), lens)\n",
        "        at = _st(lens.to_original(_centres(lens, width, height, top)), lens)\n",
        f"{TEST}overscan.py::test_blenders_map_uv_undistorts_and_gives_the_original_back",
    ),
    Answer(
        7,
        "overscan is as much as the lens and a filter need",
        "torch_backend/solve/stmap.py",
        "    across, down = (math.ceil(p) + _FILTER_PX if p > _TOUCHING_PX else 0 for p in past)\n",
        "    across, down = (0 for p in past)\n",
        "tests/backend/solve/test_lens.py::test_with_overscan_no_pixel_lacks_data",
    ),
    Answer(
        8,
        "frame n shows plate n",
        f"{ADDON}scene/sequences.py",
        "    user.frame_offset = first - 1\n",
        "    user.frame_offset = 0\n",
        f"{TEST}cameras.py::test_plate_fits_the_sensor_and_follows_the_frame_numbers",
    ),
    Answer(
        8,
        "the plate fits the sensor",
        CAMERAS,
        '    background.frame_method = "FIT"\n',
        '    background.frame_method = "STRETCH"\n',
        f"{TEST}cameras.py::test_plate_fits_the_sensor_and_follows_the_frame_numbers",
    ),
    Answer(
        9,
        "a child that was killed has failed",
        f"{ADDON}process/jobs.py",
        '    status.state = "failed"\n    status.exit_code = code',
        '    status.state = "done"\n    status.exit_code = code',
        f"{TEST}jobs.py::test_a_killed_child_leaves_a_status_that_says_so",
    ),
    Answer(
        10,
        "added steps have a file of their own until they are done",
        "torch_backend/contract/shot_folder.py",
        '"checkpoint.safetensors", "extension.safetensors"',
        '"checkpoint.safetensors", "checkpoint.safetensors"',
        "tests/backend/train/test_extend.py::test_the_finished_run_stays_until_the_last_added_step",
    ),
    Answer(
        10,
        "interrupted steps are gone on with",
        "torch_backend/train/extend.py",
        "    return last if begun_on == ",
        "    return None if begun_on == ",
        "tests/backend/train/test_extend.py::test_an_interrupted_extension_ends_exactly_where_an_unbroken_one_does",
    ),
    Answer(
        11,
        "the environment's path is short",
        f"{ADDON}process/environment.py",
        '    return Path.home() / ".splannequin"\n',
        '    return Path.home() / "x" * 200\n',
        f"{TEST}environment.py::test_the_folder_is_short",
    ),
    Answer(
        12,
        "a closed session ends its process",
        f"{ADDON}freeze/live.py",
        "            self._closed = True\n",
        "            pass\n",
        f"{TEST}live.py::test_a_closed_session_leaves_no_process",
    ),
    Answer(
        12,
        "a process that does not end is ended",
        f"{ADDON}freeze/live.py",
        "            process.kill()\n",
        "            pass\n",
        f"{TEST}live.py::test_a_session_that_hangs_is_ended",
    ),
    Answer(
        13,
        "Cancel reaches the job",
        f"{ADDON}process/jobs.py",
        "        os.close(os.open(flag, os.O_WRONLY | os.O_CREAT | os.O_EXCL))",
        "        pass",
        f"{TEST}jobs.py::test_cancel_ends_a_job",
    ),
    Answer(
        13,
        "a render can be stopped between frames",
        f"{ADDON}bake/rendering.py",
        "                check_cancelled()\n",
        "                pass\n",
        f"{TEST}headless.py::test_ctrl_c_while_frames_render_ends_the_bake_with_130",
    ),
    Answer(
        14,
        "running jobs are found again",
        f"{ADDON}process/jobs.py",
        "        found[kind] = job\n",
        "        pass\n",
        f"{TEST}jobs.py::test_another_blender_finds_a_running_job_and_its_end",
    ),
    Answer(
        14,
        "jobs do not end with Blender",
        f"{ADDON}process/children.py",
        '    return {"start_new_session": True}\n',
        "    return {}\n",
        f"{TEST}jobs.py::test_a_child_runs_in_its_own_process_group",
    ),
    Answer(
        15,
        "the module with threads knows no bpy",
        f"{ADDON}freeze/live.py",
        "import threading\n",
        "import threading\n\nimport bpy  # noqa\n",
        "tests/test_wall.py::test_no_module_of_the_addon_has_both_threads_and_bpy",
    ),
    Answer(
        15,
        "a poll keeps its budget",
        f"{ADDON}process/jobs.py",
        "                if time.monotonic() > until:\n                    return events, False\n",
        "",
        f"{TEST}jobs.py::test_poll_keeps_its_budget_and_loses_nothing",
    ),
)


def main() -> int:
    """0 if every test failed without its answer, and passed with it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--backend", required=True, help="Python of the backend's environment")
    parser.add_argument("--bpy", required=True, help="Python with bpy and pytest")
    parser.add_argument("words", nargs="*", help="only answers with one of these in them")
    args = parser.parse_args()
    chosen = [a for a in ANSWERS if not args.words or any(w in f"{a.complaint} {a.what} {a.test}" for w in args.words)]
    bad = 0
    with tempfile.TemporaryDirectory(prefix="splannequin-complaints-") as name:
        folder = Path(name)
        _copy(folder)
        for answer in chosen:
            since = time.monotonic()
            verdict = _try(folder, answer, args.backend, args.bpy)
            bad += verdict != "noticed"
            print(f"{verdict:12s} {time.monotonic() - since:4.0f} s  {answer.complaint:2d}: {answer.what}", flush=True)
    print(f"{len(chosen) - bad} of {len(chosen)} answers: their test fails without them")
    return int(bad > 0)


def _copy(folder: Path) -> None:
    """The checkout's tracked and new files."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    for file in subprocess.run(command, cwd=ROOT, capture_output=True, check=True).stdout.decode().split("\0"):
        if file and (ROOT / file).is_file():
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            (folder / file).write_bytes((ROOT / file).read_bytes())


def _try(folder: Path, answer: Answer, backend: str, bpy: str) -> str:
    """Runs the test with the answer and without; what happened, in a word: 'noticed' is what should."""
    path = folder / answer.file
    text = path.read_text(encoding="utf-8")
    if text.count(answer.old) != 1:
        return "TEXT NOT FOUND"
    if _run(folder, answer, backend, bpy):
        return "FAILS BEFORE"
    path.write_text(text.replace(answer.old, answer.new), encoding="utf-8")
    try:
        code = _run(folder, answer, backend, bpy)
    finally:
        path.write_text(text, encoding="utf-8")
    return "noticed" if code else "NOT NOTICED"


def _run(folder: Path, answer: Answer, backend: str, bpy: str) -> int:
    python = bpy if answer.test.startswith("tests/addon") else backend
    environ = {**os.environ, "SPLANNEQUIN_BACKEND_PYTHON": backend, "PYTHONPATH": str(folder)}
    command = [python, "-P", "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", answer.test]
    try:
        return subprocess.run(command, cwd=folder, env=environ, capture_output=True, timeout=180).returncode
    except subprocess.TimeoutExpired:
        return 1  # a test that waits for what never comes has noticed, too


if __name__ == "__main__":
    sys.exit(main())
