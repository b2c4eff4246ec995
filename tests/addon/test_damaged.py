"""Shots with damaged or foreign files: no read in Blender hangs or raises, and no damaged value is drawn."""

import copy
import json
import os
import random
import socket
import sys
import threading
from pathlib import Path

import pytest

RUN, TAKE = "runs/main/summary.json", "takes/freeze/take.json"
WEIRD = [
    None, True, -1, 0, 10**12, 10**400, 1e308, float("nan"), float("-inf"), "", "x" * 5000, "\x1b[31mred\n", "\ud800",
    "../../up", [], [None], [[]], {}, {"a": {}}, "²",
]  # fmt: skip


@pytest.fixture
def full_shot(addon, contract, shot) -> Path:
    """Test shot with a paused run, measurements, and an ended job of every kind."""
    (shot / "runs" / "main" / "metrics.jsonl").write_text('{"seconds": 1.0, "heldout_psnr_db": 20.0}\n' * 3)
    jobs = addon("process.jobs")
    for kind, cls in contract.PARAMS.items():
        folder = jobs.new_job(shot, kind, cls()).folder
        status = {"kind": kind, "state": "done", "pid": 1, "started": 1.0, "process_started": 2.0, "heartbeat": 2.0}
        (folder / "status.json").write_text(json.dumps({**status, "stage": "s", "fraction": 0.5, "host": "elsewhere"}))
        events = [("warning", {"message": "m", "hint": "h"}), ("image", {"label": "preview", "path": "p.png"})]
        events += [("metric", {"stage": "s", "values": {"seconds": 1, "heldout_psnr_db": 2}})]
        events += [("done", {"state": "done", "result": {"t_star_frame": 6, "take": "freeze", "first": 5, "last": 7}})]
        lines = [{"type": t, "seq": n, "time": 1.0, "data": d, "version": 1} for n, (t, d) in enumerate(events)]
        (folder / "events.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
        (folder / "log.txt").write_text("a line\n")
        (folder / "step").write_text("footage")
    return shot


def files_of(shot: Path) -> list[Path]:
    """Files of a shot that Blender's main thread reads."""
    named = ["shot.json", "frames/frames.json", "solve/solve.json", RUN, TAKE, "runs/main/metrics.jsonl"]
    jobs = sorted(p for p in (shot / "jobs").glob("*/*") if "train" in p.parent.name)
    return [*(shot / name for name in named), *jobs]


@pytest.fixture
def look(addon, scene):
    """look(shot): does all that Blender does with a chosen shot; returns every text that Blender would draw."""
    supervisor, jobs, steps, listing = (
        addon("process.job_timer"),
        addon("process.jobs"),
        addon("process.steps").STEPS,
        addon("ui.listing"),
    )

    def all_of(shot: Path) -> list[str]:
        supervisor.forget()
        scene.splannequin.shot_path = str(shot)
        watch = supervisor.watch_of(shot)
        texts = [words for failure in watch.failures.values() for words in failure]
        for name, step in steps.items():
            shown = step.view(scene, watch.state)
            texts += [*shown.state, shown.advice, name]
        for row in listing.run_rows(watch.state) + listing.take_rows(watch.state):
            texts += row
        texts += [reason for damaged in watch.state.damaged.values() for reason in damaged.values()]
        addon("train.training").plan(watch.state, "main", "preview")
        for run in watch.state.runs.values():
            if len(run["history"]) > 1:
                addon("train.pictures").curve(run["history"], (64, 32))
        for job in jobs.latest(shot).values():
            job.status = None
            jobs.poll(job)
            texts += jobs.log_tail(job.folder)
            if job.status is not None:
                texts += [job.status.message, job.status.stage, job.status.hint]
            texts += [words for warning in job.warnings for words in warning]
        names = addon("train.settings").runs_of(scene.splannequin) + addon("freeze.settings").takes_of(
            scene.splannequin
        )
        texts += [words for pair in names for words in pair]
        return texts

    return all_of


def test_a_whole_shot_is_not_damaged(look, full_shot, addon):
    assert not any("damaged" in text or "cannot be read" in text for text in look(full_shot))
    state = addon("shot.inventory").read(full_shot)
    assert state.listed("run") == ["main"] and state.listed("take") == ["freeze"] and len(state.runs["main"]["history"])


def mutated(value: object, random_: random.Random) -> object:
    """Copy of a JSON value with one part changed or removed."""
    value = copy.deepcopy(value)
    if not isinstance(value, (dict, list)) or not value or random_.random() < 0.15:
        return random_.choice(WEIRD)
    key = random_.choice(list(value) if isinstance(value, dict) else range(len(value)))
    if random_.random() < 0.2:
        del value[key]
    else:
        value[key] = mutated(value[key], random_)
    return value


def test_damaged_files_are_skipped_or_reported(look, full_shot):
    random_ = random.Random(13)  # noqa: S311
    files = [f for f in files_of(full_shot) if f.suffix in (".json", ".jsonl")]
    for n in range(100):
        path = random_.choice(files)
        before = path.read_bytes()
        lines = before.splitlines()
        line = random_.randrange(len(lines)) if path.suffix == ".jsonl" else 0
        whole = json.loads(lines[line] if path.suffix == ".jsonl" else before)
        after = json.dumps(mutated(whole, random_)).encode()
        if random_.random() < 0.2:
            cut = random_.randrange(len(after) + 1)
            after = after[:cut] + random_.randbytes(3) + after[cut:]
        elif random_.random() < 0.05:
            after = b"[" * 100_000
        lines[line : None if path.suffix == ".json" else line + 1] = [after]
        path.write_bytes(b"\n".join(lines) + b"\n")
        try:
            for text in look(full_shot):
                assert len(text) < 6000 and (text.isprintable() or len(text.splitlines()) == 1)
                text.encode("utf-8")
        except Exception as error:
            raise AssertionError(f"mutation {n}: {path.name} with {after[:300]!r}") from error
        path.write_bytes(before)


@pytest.mark.skipif(sys.platform == "win32", reason="special files are POSIX")
@pytest.mark.parametrize("what", ["pipe", "zero", "socket", "folder", "dangling", "itself"])
def test_files_that_are_none_hold_nothing_up(look, full_shot, what, tmp_path):
    ended = threading.Event()
    watchdog = threading.Thread(target=lambda: ended.wait(60) or os._exit(3), daemon=True)
    watchdog.start()  # a read of a pipe blocks forever, and no exception can interrupt it
    for path in files_of(full_shot):
        before = path.read_bytes()
        path.unlink()
        if what == "pipe":
            os.mkfifo(path)
        elif what == "zero":
            path.symlink_to("/dev/zero")
        elif what == "socket":
            os.chdir(path.parent)  # a socket's path may have at most 100 characters
            socket.socket(socket.AF_UNIX).bind(path.name)
            os.chdir(tmp_path)
        elif what == "folder":
            path.mkdir()
        else:
            path.symlink_to(path if what == "itself" else path.parent / "gone")
        look(full_shot)
        path.rmdir() if what == "folder" else path.unlink()
        path.write_bytes(before)
    ended.set()


def test_a_damaged_run_and_take_are_shown_as_such(look, full_shot, addon):
    shots, listing = addon("shot.inventory"), addon("ui.listing")
    for file in (RUN, TAKE):
        content = json.loads((full_shot / file).read_text())
        (full_shot / file).write_text(json.dumps({**content, "run": ["main"]}))
    state = shots.read(full_shot)
    assert state.runs == {} and state.takes == {}
    assert listing.run_rows(state) == [("main", "damaged")] and listing.take_rows(state) == [("freeze", "damaged")]
    assert state.damaged["run"]["main"].endswith("summary.json is damaged: Run.run cannot be a list.")
    assert any("take.json is damaged: Take.run" in text for text in look(full_shot))


def test_folders_that_cannot_be_shown_are_no_runs(full_shot, addon):
    names = ["main\n", ".main.new", os.fsdecode(b"\xff")]
    for name in names if sys.platform == "linux" else names[1:2]:
        (full_shot / "runs" / name).mkdir()
        (full_shot / "runs" / name / "summary.json").write_text('{"gaussians": 3}')
    assert addon("shot.inventory").read(full_shot).listed("run") == ["main"]


def test_a_line_without_end_does_not_fill_the_memory(full_shot, addon, contract):
    jobs = addon("process.jobs")
    job = next(job for job in jobs.latest(full_shot).values() if job.kind == "train")
    with open(job.folder / "events.jsonl", "r+b") as events:
        events.truncate(1 << 40)  # a sparse file, which uses no disk space
    events = jobs.poll(job, 0.05)
    assert not events and job.read_to < 1 << 32
    long = b'{"type": "' + b"x" * (3 * contract.LONGEST_LINE) + b'"}\n'
    short = b'{"type": "warning", "seq": 0, "time": 0, "data": {"message": "after", "hint": ""}}\n'
    (job.folder / "events.jsonl").write_bytes(long + short)
    job.read_to, job.warnings = 0, []
    jobs.poll(job, 1.0)
    assert job.warnings == [("after", "")]
