"""A take in parts, for many computers at once: opened once, frozen in parts, finished once.

    open_take      what all parts share: the instant is chosen and developed, and what the take shows is written down
    freeze_part    frames of a range; any number of parts at once, in any order, on any computer
    finish_take    contact sheet, video, splats and take.json, when all frames are there

Each may run twice, also at once, and after it was killed: nothing that is right is removed, every file is renamed into
its place whole, and two who make the same frame write the same bytes. Nobody holds the shot's lock: parts of different
takes, and of one, do not wait for each other.
"""

from __future__ import annotations

from typing import Any

from ...contract import (
    ExitCode,
    FreezeParams,
    JobError,
    Reporter,
    TakeFolder,
    read_json,
    remove_file,
)
from ...shot import Shot, write_json
from ..frozen import OutputFrame
from .cameras import in_range
from .folder import files_of, frames_of, made_before, make_folders, outdated, right_frames, stored_key, stored_keys
from .frames import render_frames
from .job import finish
from .plan import PlannedTake, planned


def open_take(shot: Shot, params: FreezeParams, report: Reporter) -> dict[str, Any]:
    """Begins a take: chooses its instant, develops it if that is wanted, and writes state.json.

    Returns {t_star, first, last, frames}: what parts are to be made of. JobError in words if it cannot be done.
    """
    take = planned(shot, params, report)
    make_folders(take.folder, take.spec)
    take.spec.instants.prepare((f.t_star for f in take.whole), report)
    _refuse_undeveloped(take)
    chosen = in_range(take.whole, params)
    keys = stored_keys(take.folder, take.spec)
    if "" in keys.values():
        report.warning(*made_before(params.take))
    if set(keys) - right_frames(take, keys):
        remove_file(take.folder.facts)  # what it tells of goes, frame by frame
    state = {"version": 1, "key": take.key, "t_star": take.t_star, "frames": take.all_keys}
    write_json(take.folder.state, state)
    return {"t_star": take.t_star, "first": chosen[0].frame, "last": chosen[-1].frame, "frames": len(chosen)}


def freeze_part(shot: Shot, params: FreezeParams, report: Reporter) -> dict[str, Any]:
    """Renders those frames of `params.first` to `params.last` that an opened take lacks.

    A range without a frame is no error: the last part of a take may be empty. Returns {frames, rendered}. JobError if
    the take was not opened, or not as this computer sees it.
    """
    take = _opened(shot, params, report)
    _refuse_undeveloped(take)
    try:
        frames = in_range(take.whole, params)
    except JobError:
        frames = []
    done = _right_of(take, frames)
    render_frames(take, frames, done, report, lambda: _refuse_opened_anew(take))
    if take.spec.run.stale:
        raise JobError(
            "The run was trained while it was frozen.", "Open the take again, then freeze its parts.", ExitCode.FREEZE
        )
    return {"frames": len(frames), "rendered": len(frames) - len(done)}


def finish_take(shot: Shot, params: FreezeParams, report: Reporter) -> dict[str, Any]:
    """Completes an opened take whose frames from `params.first` to `params.last` are all there.

    Earlier frames that are not right any more are removed. Returns what take.json holds. JobError names frames that
    lack.
    """
    take = _opened(shot, params, report)
    wanted = in_range(take.whole, params)
    right = _right_of(take, take.whole)
    lacking = [f.frame for f in wanted if f.frame not in right]
    if lacking:
        raise JobError(
            f"Take {params.take} of {shot.root.name} lacks {len(lacking)} of {len(wanted)} frames, the first is "
            f"{lacking[0]}.",
            "Run the part that it belongs to again.",
            ExitCode.FREEZE,
        )
    if (warning := outdated(take, right)) is not None:
        report.warning(*warning)
    for number in frames_of(take.folder):
        if number not in right:
            for old in files_of(take.folder, number):
                remove_file(old)
    return finish(shot, params, take, [f for f in take.whole if f.frame in right], {}, report)


def _right_of(take: PlannedTake, frames: list[OutputFrame]) -> set[int]:
    """Those of some frames that are on disk as they would be rendered now."""
    return right_frames(take, {f.frame: stored_key(take.folder, f.frame, take.spec) for f in frames})


def _opened(shot: Shot, params: FreezeParams, report: Reporter) -> PlannedTake:
    """The take as `open_take` settled it. JobError if it did not, or if this computer would render something else."""
    try:
        state = read_json(TakeFolder(shot.take(params.take)).state)
        t_star = int(state["t_star"])
    except (OSError, ValueError, KeyError, TypeError):
        raise JobError(
            f"Take {params.take} of {shot.root.name} was not opened.", "Run its step `open` first.", ExitCode.FREEZE
        ) from None
    take = planned(shot, params, report, t_star)
    if state.get("key") != take.key or state.get("frames") != take.all_keys:
        raise JobError(
            f"Take {params.take} of {shot.root.name} was opened with another run, other footage or other settings than "
            "this computer sees.",
            "See that the footage can be read here and that nobody trains the run, then run the step `open` again.",
            ExitCode.FREEZE,
        )
    return take


def _refuse_opened_anew(take: PlannedTake) -> None:
    """JobError if the take was opened with something else since: this part's frames would replace newer ones."""
    try:
        state = read_json(take.folder.state)
    except (OSError, ValueError):
        state = {}
    if state.get("frames") != take.all_keys:
        raise JobError(
            f"The take {take.folder.root.name} was opened with something else while a part of it was frozen.",
            "Freeze the parts of the job that opened it last.",
            ExitCode.FREEZE,
        )


def _refuse_undeveloped(take: PlannedTake) -> None:
    """JobError if an instant of the take is not kept where every part finds it: parts that made their own would not
    match."""
    lacking = [int(t) for t in take.spec.instants.keys if not take.spec.instants.is_kept(t)]
    if lacking:
        raise JobError(
            f"The developed instant {lacking[0]} is not kept with the run.",
            "Run the step `open` again; it says why, if it cannot be written.",
            ExitCode.FREEZE,
        )
