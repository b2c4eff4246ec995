"""A live session as used by Blender: a child process that receives views and sends frames."""

import dataclasses
import io
import json
import os
import shutil
import subprocess
import sys
from collections import OrderedDict
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from torch_backend.contract import (
    NO_DEPTH,
    CameraPath,
    ExitCode,
    FreezeParams,
    LiveView,
    python_child,
    read_message,
    write_message,
)
from torch_backend.footage.color import linear_to_srgb
from torch_backend.freeze import freeze_shot
from torch_backend.freeze.exr import read_frozen_exr
from torch_backend.freeze.take.plan import choose_t_star
from torch_backend.live import _TINT, _TINTED, LiveSession, Superseded, _Waiting, serve
from torch_backend.shot import Shot, write_json
from torch_backend.train import device
from torch_backend.train.self_test import SelfTest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def session(trained):
    """The child process after its `ready` message, and that message. Tests must read every answer."""
    child = start(trained.shot.root)
    header, body = read_message(child.stdout)
    assert body == b""
    yield child, header
    child.stdin.close()
    assert child.wait(20) == 0
    child.stdout.close()


@pytest.fixture(scope="module")
def local(trained):
    """A session in this process."""
    return LiveSession(trained.shot, "main", "cpu")


def start(shot, run="main"):
    command = python_child(sys.executable, "torch_backend", "live", str(shot), "--run", run, "--device", "cpu")
    environ = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.Popen(**command, env=environ, stdin=subprocess.PIPE, stdout=subprocess.PIPE)


def view_of(world, frame, t_star, width=64, height=48, **more):
    path = CameraPath.load(world.shot.solve / "cameras.json")
    camera = next(f for f in path.frames if f.frame == frame)
    x, y = width / path.width, height / path.height
    k = [camera.K[0] * x, camera.K[1] * y, camera.K[2] * x, camera.K[3] * y]
    facts = {"view": 1, "seq": 7, "viewmat": camera.viewmat, "K": k, "width": width, "height": height}
    return {"kind": "view", **facts, "t_star": t_star, **more}


def picture(answer):
    header, body = answer
    assert header["kind"] == "frame", header
    w, h = header["width"], header["height"]
    values = np.frombuffer(body, np.float32)
    return values[: 4 * w * h].reshape(h, w, 4), values[4 * w * h :].reshape(h, w)


def ask(child, header):
    write_message(child.stdin, header)
    return read_message(child.stdout)


def test_ready_message_lists_what_can_be_frozen(session, trained):
    summary = trained.summary
    header = session[1]
    assert header["kind"] == "ready"
    assert (header["first"], header["last"]) == (101, 116)
    assert header["gaussians"] == summary["gaussians"]
    assert 0 < header["moving"] < header["gaussians"]
    frames = [s["frame"] for s in header["suggestions"]]
    assert len(frames) >= 2
    assert len(frames) == len(set(frames))
    assert set(frames) <= set(header["trained"])
    assert all(0 <= s["seen"] <= 1 and 0 <= s["sharpness"] <= 1 for s in header["suggestions"])


def test_only_instants_that_the_runs_verdict_recommends_are_suggested(trained, quiet):
    record = trained.shot.run("main") / "summary.json"
    before = json.loads(record.read_text())
    advised = {
        "word": "fair",
        "sentences": ["It does not match the clip in frames 101 to 109, left."],
        "instants": [110, 114],
    }
    write_json(record, {**before, "verdict": advised})
    try:
        session = LiveSession(trained.shot, "main", "cpu")
        frames = [s["frame"] for s in session.facts()["suggestions"]]
        chosen = choose_t_star(trained.shot, session.scene, session.run, FreezeParams(), quiet())
    finally:
        write_json(record, before)
    assert frames and all(110 <= frame <= 114 for frame in frames) and chosen == frames[0]


def test_ready_says_why_the_card_is_not_used(session, trained, monkeypatch):
    assert session[1]["note"] == "", "on the processor by wish"
    monkeypatch.setattr(device, "cuda_refusal", lambda: "")
    monkeypatch.setattr(device, "card_verdict", lambda: SelfTest(problem="a frame comes out wrong on it"))
    note = LiveSession(trained.shot, "main", "auto").facts()["note"]
    assert note.startswith("Scrubbing uses the processor, not the graphics card: ") and "doctor --gpu" in note


def test_a_view_is_the_frame_that_a_take_renders(session, trained, quiet):
    part = dict(t_star=112, first=105, last=105, detail="off", develop="off")
    freeze_shot(trained.shot, FreezeParams(take="live", **part), quiet())
    want = read_frozen_exr(trained.shot.take("live") / "000105.exr")
    rgba, depth = picture(ask(session[0], view_of(trained, 105, 112.2, exposed_like=105.0, develop=False)))
    seen = want.rgba[..., 3] > 0.99
    assert seen.mean() > 0.9
    assert np.abs(rgba[..., :3] - linear_to_srgb(want.rgba[..., :3]))[seen].max() < 4e-3
    # A view has the depth of the splats; a take's depth is measured (`surface_depth.py`).
    assert np.median(np.abs(depth[seen] / want.depth[seen] - 1)) < 0.02
    assert bool((depth[rgba[..., 3] == 0] == np.float32(NO_DEPTH)).all())
    tinted, _ = picture(ask(session[0], view_of(trained, 105, 112, show="guesses", exposed_like=105.0, develop=False)))
    guess = _TINTED * (1.0 - want.support)[..., None]
    expected = rgba[..., :3] * (1.0 - guess) + guess * rgba[..., 3:] * np.array(_TINT)
    assert np.abs(tinted[..., :3] - expected)[seen].max() < 4e-3
    for show in ("support", "motion"):
        matte, _ = picture(ask(session[0], view_of(trained, 105, 112, show=show, develop=False)))
        assert np.abs(matte[..., 0] - getattr(want, show) * want.rgba[..., 3]).max() < 4e-3


def test_a_view_at_rest_is_the_frame_that_a_take_makes_of_plates(session, trained, quiet):
    freeze_shot(trained.shot, FreezeParams(take="plates", t_star=112, first=105, last=105), quiet())
    want = read_frozen_exr(trained.shot.take("plates") / "000105.exr")
    request = view_of(trained, 105, 112.2, exposed_like=105.0)
    request["viewmat"] = [v + 1e-6 for v in request["viewmat"]]  # rounding as from Blender
    splats, plates = (picture(ask(session[0], {**request, "detail": detail})) for detail in (False, True))
    shown = linear_to_srgb(want.rgba[..., :3]).clip(0, 1)
    difference = np.abs(plates[0][..., :3] - shown).max(-1)
    assert np.quantile(difference, 0.9) < 4e-3
    assert difference.max() < 0.05  # filled areas differ, because fewer plates are used
    assert np.abs(plates[0][..., 3] - want.rgba[..., 3]).max() < 1 / 255
    seen = want.rgba[..., 3] > 0.99
    np.testing.assert_array_equal(plates[1], splats[1])
    assert np.median(np.abs(plates[1][seen] / want.depth[seen] - 1)) < 0.02
    assert np.abs(splats[0][..., :3] - shown).mean() > 3.0 * difference.mean()
    for show in ("guesses", "support", "motion"):
        plain, same = (picture(ask(session[0], {**request, "show": show, "detail": d}))[0] for d in (False, True))
        np.testing.assert_array_equal(plain, same)


@pytest.mark.parametrize("size", [(64, 48), (150, 60), (20, 30)])
def test_view_of_any_size_uses_plates(trained, local, size):
    width, height = size
    k = [width * 60 / 64, width * 60 / 64, 0.4 * width, 0.6 * height]
    request = {**view_of(trained, 105, 105, *size, exposed_like=105.0), "K": k}
    del request["kind"]
    splats, plates = (picture(local.draw(LiveView(**request, detail=detail)))[0] for detail in (False, True))
    assert plates.shape == (height, width, 4)
    covered = splats[..., 3] > 0.99
    # The same view: the splats are at the right place, but soft.
    assert np.abs(plates - splats)[covered].mean() < 0.03
    assert np.abs(plates - splats)[covered].max() > 1e-3


def test_plate_view_yields_to_a_newer_request_and_finishes_later(session, trained):
    child, _ = session
    requests = [
        {"view": 1, "seq": 1, "detail": True},
        {"view": 2, "seq": 2},
        {"view": 3, "seq": 3, "detail": True},
        {"view": 3, "seq": 4, "detail": True},
        {"view": 2, "seq": 5},
    ]
    for change in requests:
        write_message(child.stdin, {**view_of(trained, 105, 108, exposed_like=105.0), **change})
    came = []
    while not {1, 4, 5} <= set(came):
        header, _ = read_message(child.stdout)
        assert header["kind"] == "frame"
        came.append(header["seq"])
    write_message(child.stdin, {**view_of(trained, 105, 108), "view": 9, "seq": 9})
    while came[-1] != 9:  # an abandoned view is not drawn later
        came.append(read_message(child.stdout)[0]["seq"])
    assert len(set(came)) == len(came)
    assert came.index(5) < max(came.index(1), came.index(4))


def test_plate_view_is_interruptible_between_plates(trained, local):
    request = {k: v for k, v in view_of(trained, 105, 112, exposed_like=105.0).items() if k != "kind"}
    view = LiveView(**request, detail=True)
    turns = iter([False, False, True])
    with pytest.raises(Superseded):
        local.draw(view, lambda: next(turns))
    again, fresh = local.draw(view)[1], LiveSession(trained.shot, "main", "cpu").draw(view)[1]
    assert again == fresh, "what was given up leaves nothing behind"
    newer = dataclasses.replace(view, seq=9)
    waiting = _Waiting()
    for waits, better in ((newer, True), (dataclasses.replace(newer, view=2), False),
                          (dataclasses.replace(newer, view=2, detail=False), True)):  # fmt: skip
        waiting._views = OrderedDict({waits.view: waits})
        assert waiting.better_than(view) == better
    waiting._views = OrderedDict({1: newer, 2: dataclasses.replace(view, view=2, detail=False)})
    waiting.requeue(view)
    assert waiting.next().view == 2
    assert waiting.next() is newer


def test_missing_footage_is_reported_and_splat_views_continue(trained, tmp_path):
    torn = Shot(shutil.copytree(trained.shot.root, tmp_path / "torn.splannequin"))
    session = LiveSession(torn, "main", "cpu")
    for picture_file in torn.frames.glob("*.png"):
        picture_file.write_bytes(b"torn")
    with ThreadPoolExecutor(1) as pool:
        pairs = (os.pipe(), os.pipe())
        (requests, asked), (answered, answers) = ((os.fdopen(r, "rb"), os.fdopen(w, "wb")) for r, w in pairs)
        served = pool.submit(serve, session, requests, answers)
        pipes = SimpleNamespace(stdin=asked, stdout=answered)
        read_message(answered)
        header, _ = ask(pipes, view_of(trained, 105, 108, detail=True))
        assert (header["kind"], header["seq"]) == ("error", 7)
        assert "damaged" in header["message"] or "cannot be read" in header["message"]
        picture(ask(pipes, view_of(trained, 105, 108)))
        asked.close()
        assert served.result() is None
        for pipe in (requests, answers, answered):
            pipe.close()


def test_guesses_are_tinted_by_how_ill_they_were_seen(trained):
    session = LiveSession(trained.shot, "main", "cpu")
    session._at(112, True).support[:] = 0.25
    request = {k: v for k, v in view_of(trained, 105, 112).items() if k != "kind"}
    plain, tinted = (picture(session.draw(LiveView(**request, show=show)))[0] for show in ("color", "guesses"))
    guess = 0.75 * _TINTED
    expected = plain[..., :3] * (1.0 - guess) + guess * plain[..., 3:] * np.array(_TINT)
    seen = plain[..., 3] > 0.99
    assert np.abs(tinted[..., :3] - expected)[seen].max() < 1e-3
    assert np.abs(tinted - plain)[seen].max() > 0.1


def test_two_instants_differ_where_the_patch_moved(session, trained):
    early, late = (picture(ask(session[0], view_of(trained, 108, t)))[0] for t in (105, 112))
    truth = (trained.image(7, 4 / 15) - trained.image(7, 11 / 15)).abs().mean(-1).numpy()
    assert np.abs(early - late)[truth > 0.1].mean() > 0.05


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"show": "beauty"}, "color, guesses, support, motion"),
        ({"width": 0}, "pixels"),
        ({"t_star": 1e400}, None),
        ({"more": 1}, "no field"),
    ],
)
def test_a_request_that_makes_no_sense_is_answered_in_words_and_the_session_goes_on(session, trained, change, words):
    request = {**view_of(trained, 105, 105), **change}
    if words is None:
        with pytest.raises(ValueError, match="JSON"):
            write_message(session[0].stdin, request)
    else:
        header, _ = ask(session[0], request)
        assert (header["kind"], header["seq"]) == ("error", 7)
        assert words in header["message"]
    picture(ask(session[0], view_of(trained, 105, 105)))


def test_a_shot_without_the_run_ends_in_a_sentence(trained):
    child = start(trained.shot.root, "other")
    header, _ = read_message(child.stdout)
    assert header["kind"] == "error"
    assert "'other'" in header["message"]
    assert child.wait(20) == ExitCode.FREEZE
    for pipe in (child.stdin, child.stdout):
        pipe.close()


def test_newer_requests_replace_those_that_wait(trained):
    stream = io.BytesIO()
    for seq, view in ((1, 1), (2, 2), (3, 1)):
        write_message(stream, {**view_of(trained, 105, 105), "seq": seq, "view": view})
    stream.seek(0)
    waiting = _Waiting()
    waiting.read(stream)
    waiting._ended = False
    assert [waiting.next().seq, waiting.next().seq] == [3, 2]


def test_messages_survive_a_pipe_that_gives_little_at_a_time():
    class Slow(io.BytesIO):
        def read(self, count=-1):
            return super().read(min(count, 3))

    stream = Slow()
    write_message(stream, {"kind": "x"}, b"abcdefgh")
    whole = stream.getvalue()
    stream.seek(0)
    assert read_message(stream) == ({"kind": "x"}, b"abcdefgh")
    assert read_message(stream) is None
    assert read_message(io.BytesIO(whole[:-1])) is None
    with pytest.raises(ValueError, match="not a message"):
        read_message(io.BytesIO(b"Traceback (most recent call last):"))
    with pytest.raises(ValueError, match="JSON object"):
        read_message(io.BytesIO(whole.replace(json.dumps({"kind": "x"}).encode(), b'["kind", "x"]')[:]))
