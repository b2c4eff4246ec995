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
if str(ROOT / "tests") not in sys.path:
    sys.path.insert(0, str(ROOT / "tests"))

from proofs import Change  # noqa: E402  # pyright: ignore[reportMissingImports]


@dataclass(frozen=True)
class Answer:
    """One thing that can be taken out."""

    complaint: int
    """Row of the table in docs/blender.md."""
    what: str
    """The answer, in a few words."""
    package: str
    """Folder or file that it stands in; see `proofs.Change`."""
    symbol: str
    """Function, class or constant that it stands in, wherever that is in the package."""
    old: str
    """Its text, once in the symbol."""
    new: str
    """What stands there without it."""
    test: str
    """The test that then fails, as pytest names it."""

    def made(self, root: Path) -> tuple[Path, str]:
        """(file, its text without the answer). LookupError, in a sentence, if it is not there any more."""
        who = f"the answer {self.what!r} to complaint {self.complaint}"
        return Change(self.package, self.symbol, self.old, self.new).made(root, who)


TEST = "tests/addon/test_"
ANSWERS = (
    Answer(
        1,
        "the zip holds no wheels",
        "blender_manifest.toml",
        "",
        "[build]",
        'wheels = ["./wheels/torch-2.13.0-cp311-cp311-win_amd64.whl"]\n\n[build]',
        f"{TEST}package.py::test_source_and_zip_are_valid_and_hold_what_is_needed",
    ),
    Answer(
        2,
        "the artist's stream goes on through the group",
        "splannequin_addon",
        "lead_through",
        'tree.links.new(source, node.inputs["Image"])',
        "pass",
        f"{TEST}compositor.py::test_artists_nodes_and_links_stay_identical",
    ),
    Answer(
        2,
        "a second bake updates the group",
        "splannequin_addon",
        "insert",
        "if node is None:\n        node = freeze_group.new_node(tree, before)",
        "if True:\n        node = freeze_group.new_node(tree, before)",
        f"{TEST}compositor.py::test_second_bake_updates_the_group",
    ),
    Answer(
        2,
        "removal leads the artist's link back",
        "splannequin_addon",
        "lead_past",
        "tree.links.new(sources[0], target)",
        "pass",
        f"{TEST}compositor.py::test_removal_restores_the_tree",
    ),
    Answer(
        3,
        "a camera is read frame by frame",
        "splannequin_addon",
        "evaluated",
        "scene.frame_set(number)",
        "",
        f"{TEST}cameras.py::test_an_artists_camera_is_read_in_solve_units",
    ),
    Answer(
        3,
        "t* is read frame by frame",
        "splannequin_addon",
        "keyed_instants",
        "float(curve.evaluate(n))",
        "float(curve.evaluate(low))",
        f"{TEST}cameras.py::test_a_keyed_instant_is_followed_frame_by_frame",
    ),
    Answer(
        4,
        "the nearer of CG and frozen shows",
        "splannequin_addon",
        "_nearer",
        "group.links.new(cg, ratio.inputs[0])\n    group.links.new(frozen, ratio.inputs[1])",
        "group.links.new(frozen, ratio.inputs[0])\n    group.links.new(cg, ratio.inputs[1])",
        f"{TEST}compositor.py::test_cg_stands_in_front_and_behind_by_depth",
    ),
    Answer(
        4,
        "a rendered cube stands among the frozen",
        "splannequin_addon",
        "combine_cg",
        'tree.links.new(layers.outputs["Depth"], node.inputs["CG Depth"])',
        "pass",
        f"{TEST}compositor.py::test_a_cube_is_hidden_by_what_is_nearer_and_hides_what_is_farther",
    ),
    Answer(
        5,
        "depth is 32-bit float",
        "torch_backend/contract",
        "FRAME_LAYERS",
        '("Z",),\n        "float",',
        '("Z",),\n        "half",',
        "tests/backend/freeze/test_exr.py::test_round_trip_keeps_depth_exact_and_the_rest_to_half",
    ),
    Answer(
        6,
        "the focal length is keyed",
        "splannequin_addon",
        "key_path",
        "if varies:",
        "if False:",
        f"{TEST}cameras.py::test_lens_is_keyed_where_it_changes",
    ),
    Answer(
        6,
        "turns go the short way",
        "splannequin_addon",
        "key_path",
        "rotation.negate()",
        "pass",
        f"{TEST}cameras.py::test_quaternions_take_the_short_way",
    ),
    Answer(
        7,
        "the original comes back out of the undistorted plate",
        "torch_backend/solve",
        "redistort_map",
        "at = _st(lens.to_plate(_centres(lens, width, height, top)), lens)",
        "at = _st(lens.to_original(_centres(lens, width, height, top)), lens)",
        f"{TEST}overscan.py::test_blenders_map_uv_undistorts_and_gives_the_original_back",
    ),
    Answer(
        7,
        "overscan is as much as the lens and a filter need",
        "torch_backend/solve",
        "needed_margin",
        "across, down = (math.ceil(p) + _FILTER_PX if p > _TOUCHING_PX else 0 for p in past)",
        "across, down = (0 for p in past)",
        "tests/backend/lens/test_lens.py::test_with_overscan_no_pixel_lacks_data",
    ),
    Answer(
        8,
        "frame n shows plate n",
        "splannequin_addon",
        "show_sequence",
        "user.frame_offset = first - shift - 1",
        "user.frame_offset = 0",
        f"{TEST}cameras.py::test_plate_fits_the_sensor_and_follows_the_frame_numbers",
    ),
    Answer(
        8,
        "the plate fits the sensor",
        "splannequin_addon",
        "_show_plate",
        'background.frame_method = "FIT"',
        'background.frame_method = "STRETCH"',
        f"{TEST}cameras.py::test_plate_fits_the_sensor_and_follows_the_frame_numbers",
    ),
    Answer(
        9,
        "a child that was killed has failed",
        "splannequin_addon",
        "_declare_dead",
        'status.state = "failed"\n    status.exit_code = code',
        'status.state = "done"\n    status.exit_code = code',
        f"{TEST}jobs.py::test_a_killed_child_leaves_a_status_that_says_so",
    ),
    Answer(
        10,
        "added steps have a file of their own until they are done",
        "torch_backend/contract",
        "CHECKPOINT_FILE",
        '"checkpoint.safetensors", "extension.safetensors"',
        '"checkpoint.safetensors", "checkpoint.safetensors"',
        "tests/backend/train/test_extend.py::test_the_finished_run_stays_until_the_last_added_step",
    ),
    Answer(
        10,
        "interrupted steps are gone on with",
        "torch_backend/train",
        "pending",
        "return last if begun_on ==",
        "return None if begun_on ==",
        "tests/backend/train/test_extend.py::test_an_interrupted_extension_ends_exactly_where_an_unbroken_one_does",
    ),
    Answer(
        11,
        "the environment's path is short",
        "splannequin_addon",
        "default_folder",
        'return Path.home() / ".splannequin"',
        'return Path.home() / "x" * 200',
        f"{TEST}environment.py::test_the_folder_is_short",
    ),
    Answer(
        12,
        "a closed session ends its process",
        "splannequin_addon",
        "Session.close",
        "self._closed = True",
        "pass",
        f"{TEST}live.py::test_a_closed_session_leaves_no_process",
    ),
    Answer(
        12,
        "a process that does not end is ended",
        "splannequin_addon",
        "Session._send",
        "process.kill()",
        "pass",
        f"{TEST}live.py::test_a_session_that_hangs_is_ended",
    ),
    Answer(
        13,
        "Cancel reaches the job",
        "splannequin_addon",
        "cancel",
        "os.close(os.open(flag, os.O_WRONLY | os.O_CREAT | os.O_EXCL))",
        "pass",
        f"{TEST}jobs.py::test_cancel_ends_a_job",
    ),
    Answer(
        13,
        "a render can be stopped between frames",
        "splannequin_addon",
        "Run._written",
        "self._check_cancelled()\n        except",
        "pass\n        except",
        f"{TEST}headless.py::test_ctrl_c_while_frames_render_ends_the_bake_with_130",
    ),
    Answer(
        14,
        "running jobs are found again",
        "splannequin_addon",
        "latest",
        "found[kind] = job",
        "pass",
        f"{TEST}jobs.py::test_another_blender_finds_a_running_job_and_its_end",
    ),
    Answer(
        14,
        "jobs do not end with Blender",
        "splannequin_addon",
        "_detached",
        'return {"start_new_session": True}',
        "return {}",
        f"{TEST}jobs.py::test_a_child_runs_in_its_own_process_group",
    ),
    Answer(
        15,
        "the module with threads knows no bpy",
        "splannequin_addon",
        "Session.close",
        "with self._change:",
        "import bpy  # noqa\n\n        with self._change:",
        "tests/test_wall.py::test_no_module_of_the_addon_has_both_threads_and_bpy",
    ),
    Answer(
        15,
        "a poll keeps its budget",
        "splannequin_addon",
        "_read_events",
        "if time.monotonic() > until:\n                    return events, False",
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
    try:
        path, changed = answer.made(folder)
    except LookupError as error:
        return f"NOT THERE: {error}"
    if _run(folder, answer, backend, bpy):
        return "FAILS BEFORE"
    text = path.read_text(encoding="utf-8")
    path.write_text(changed, encoding="utf-8")
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
