"""A full disk gives a message and exit code 8, and finished work is kept. Tests mount a small disk."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from torch_backend import contract, job
from torch_backend.contract import ExitCode, TrainParams
from torch_backend.footage.images import write_png
from torch_backend.freeze.take.video import write_video
from torch_backend.shot import Shot, is_disk_full
from torch_backend.train.checkpoint import read_meta

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def disk(tmp_path):
    """disk(megabytes): mounts an empty disk of that size."""
    mounted = []

    def mount(megabytes):
        folder = tmp_path / "disk"
        folder.mkdir()
        command = ["mount", "-t", "tmpfs", "-o", f"size={megabytes}M", "tmpfs", str(folder)]
        if not shutil.which("mount") or subprocess.run(command, capture_output=True, check=False).returncode:
            pytest.skip("no disk can be mounted here: that needs Linux and root")
        mounted.append(folder)
        return folder

    yield mount
    for folder in mounted:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def fill(folder):
    with open(folder / "ballast", "ab", buffering=0) as ballast:
        try:
            while ballast.write(bytes(4096)):
                pass
        except OSError:
            return


def test_a_checkpoint_that_does_not_fit_ends_the_job_in_words(world, disk):
    folder = disk(32)
    ignored = shutil.ignore_patterns("runs", "jobs", "takes")
    shot = Shot(shutil.copytree(world.shot.root, folder / "s.splannequin", ignore=ignored))

    def train(listener, **changes):
        folder_of_job = job.new_job(shot, "train", TrainParams(iterations=20, max_gaussians=1500, **changes))
        code, _ = job.run_job(folder_of_job, listener)
        return code, contract.from_dict(contract.Status, contract.read_json(folder_of_job / contract.STATUS_FILE))

    events = []
    assert train(events.append)[0] == ExitCode.OK
    kept = (shot.run("main") / "checkpoint.safetensors").read_bytes()

    def fills(event):
        events.append(event)
        if event.type == "progress" and event.data["stage"] == "training" and event.data["done"] >= 15:
            fill(folder)

    code, _ = train(fills, seed=2)
    error = next(e.data for e in events if e.type == "error")
    assert code == error["exit_code"] == ExitCode.DISK
    assert error["message"].startswith("No space left in") and "finished work is kept" in error["hint"]
    assert (shot.run("main") / "checkpoint.safetensors").read_bytes() == kept
    assert not list(shot.root.rglob("*.tmp*")), "nothing half written is left"

    (folder / "ballast").write_bytes(bytes(1 << 20))  # room for logs, not for a checkpoint
    fill_to = shutil.disk_usage(folder).free - (4 << 20)
    with open(folder / "more", "wb") as more:
        more.write(bytes(max(0, fill_to)))
    events.clear()
    code, status = train(events.append, seed=3)
    assert code == ExitCode.DISK and "checkpoint needs about" in status.message
    assert not [e for e in events if e.type == "progress"], "said before the work, not after hours"
    assert read_meta(shot.run("main") / "checkpoint.safetensors")["config"]["seed"] == 0
    assert json.loads((shot.run("main") / "summary.json").read_text())["iterations"] == 20


def test_pictures_and_videos_are_complete_or_absent(disk):
    folder = disk(1)
    frames = np.random.default_rng(0).integers(0, 255, (6, 480, 848, 3), dtype=np.uint8)
    for write in (lambda: write_png(folder / "a.png", frames[0]), lambda: write_video(folder / "a.mp4", frames, 24.0)):
        with pytest.raises(OSError) as refused:
            write()
        assert is_disk_full(refused.value)
        assert not list(folder.iterdir())


@pytest.mark.parametrize("left", [0, 8192])
def test_a_full_kernel_cache_is_named_and_not_the_take(disk, tmp_path, left):
    """In a real child process, the kernel cache is on a full disk: the error message names its folder.

    If the disk had room for the source but not for the compiled code, LLVM would abort the process.
    """
    folder = disk(4)
    (folder / "room").write_bytes(bytes(left))
    fill(folder)
    (folder / "room").unlink()
    code = (
        "from torch_backend import job, contract\n"
        "from torch_backend.shot import Shot\n"
        "def station(shot, params, report):\n"
        "    from torch_backend.freeze.views import visibility\n"
        "    visibility.warm_up()\n"
        "job.RUNNERS['import'] = station\n"
        f"shot = Shot.create({str(tmp_path / 's.splannequin')!r})\n"
        "asked = job.new_job(shot, 'import', contract.ImportParams(source='x'))\n"
        "code, _ = job.run_job(asked)\n"
        "print((asked / contract.STATUS_FILE).read_text())\n"
        "raise SystemExit(code)\n"
    )
    environ = {**os.environ, "WARP_CACHE_PATH": str(folder / "kernels")}
    ran = subprocess.run(
        [sys.executable, "-c", code], env=environ, capture_output=True, text=True, cwd=ROOT, check=False
    )
    status = json.loads(ran.stdout)
    assert ran.returncode == ExitCode.DISK, status
    assert str(folder / "kernels") in status["message"] and "WARP_CACHE_PATH" in status["hint"]
