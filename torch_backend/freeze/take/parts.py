"""Renders a take in parts on several computers: opened once, frozen in parts, finished once.

    open_take      chooses and develops the instant, and records the key of the take for all parts
    freeze_part    renders the frames of a range; parts may run at once, in any order, on any computer
    finish_take    writes contact sheet, video, splats and take.json, once all frames exist

Each step may run twice, also concurrently, and again after it was killed. Valid files are not removed, every file is
written under a temporary name and then renamed, and two processes that render the same frame write the same bytes. No
step holds the shot's lock, so parts of one take or of several takes run concurrently.
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
from .folder import (
    current_frames,
    files_of,
    frames_of,
    make_folders,
    outdated,
    stored_key,
    stored_keys,
    unkeyed_warning,
)
from .frames import render_frames
from .job import finish
from .plan import PlannedTake, planned


def open_take(shot: Shot, params: FreezeParams, report: Reporter) -> dict[str, Any]:
    """Opens a take: chooses its instant, develops it if requested, and writes state.json.

    Returns {t_star, first, last, frames} for splitting into parts. JobError if the take cannot be opened.
    """
    take = planned(shot, params, report)
    make_folders(take.folder, take.spec)
    take.spec.instants.prepare((f.t_star for f in take.whole), report)
    _refuse_undeveloped(take)
    chosen = in_range(take.whole, params)
    keys = stored_keys(take.folder, take.spec)
    if "" in keys.values():
        report.warning(*unkeyed_warning(params.take))
    if set(keys) - current_frames(take, keys):
        remove_file(take.folder.facts)  # its frames will be replaced one by one
    state = {"version": 1, "key": take.key, "t_star": take.t_star, "frames": take.all_keys}
    write_json(take.folder.state, state)
    return {"t_star": take.t_star, "first": chosen[0].frame, "last": chosen[-1].frame, "frames": len(chosen)}


def freeze_part(shot: Shot, params: FreezeParams, report: Reporter) -> dict[str, Any]:
    """Renders the frames from `params.first` to `params.last` that an opened take lacks.

    A range without frames is valid, because the last part of a take may be empty. Returns {frames, rendered}. JobError
    if the take was not opened, or was opened with other inputs than this computer sees.
    """
    take = _opened(shot, params, report)
    _refuse_undeveloped(take)
    try:
        frames = in_range(take.whole, params)
    except JobError:
        frames = []
    done = _current_of(take, frames)
    render_frames(take, frames, done, report, lambda: _refuse_opened_anew(take))
    if take.spec.run.stale:
        raise JobError(
            "The run was trained during the freeze.", "Open the take again, then freeze its parts.", ExitCode.FREEZE
        )
    return {"frames": len(frames), "rendered": len(frames) - len(done)}


def finish_take(shot: Shot, params: FreezeParams, report: Reporter) -> dict[str, Any]:
    """Completes an opened take whose frames from `params.first` to `params.last` all exist.

    Outdated frames are removed. Returns the content of take.json. JobError names the first missing frame.
    """
    take = _opened(shot, params, report)
    requested = in_range(take.whole, params)
    current = _current_of(take, take.whole)
    lacking = [f.frame for f in requested if f.frame not in current]
    if lacking:
        raise JobError(
            f"Take {params.take} of {shot.root.name} lacks {len(lacking)} of {len(requested)} frames, the first is "
            f"{lacking[0]}.",
            "Run the part that it belongs to again.",
            ExitCode.FREEZE,
        )
    if (warning := outdated(take, current)) is not None:
        report.warning(*warning)
    for number in frames_of(take.folder):
        if number not in current:
            for old in files_of(take.folder, number):
                remove_file(old)
    return finish(shot, params, take, [f for f in take.whole if f.frame in current], {}, report)


def _current_of(take: PlannedTake, frames: list[OutputFrame]) -> set[int]:
    """Numbers of the given frames whose files on disk are up to date."""
    return current_frames(take, {f.frame: stored_key(take.folder, f.frame, take.spec) for f in frames})


def _opened(shot: Shot, params: FreezeParams, report: Reporter) -> PlannedTake:
    """The plan of an opened take. JobError if it is not open, or if its key differs on this computer."""
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
            "Make sure that the footage can be read here and that the run is not being trained, then run the step "
            "`open` again.",
            ExitCode.FREEZE,
        )
    return take


def _refuse_opened_anew(take: PlannedTake) -> None:
    """Raises JobError if the take was reopened with other inputs: this part's frames would replace newer ones."""
    try:
        state = read_json(take.folder.state)
    except (OSError, ValueError):
        state = {}
    if state.get("frames") != take.all_keys:
        raise JobError(
            f"The take {take.folder.root.name} was opened with other settings while a part of it was frozen.",
            "Freeze the parts of the job that opened it last.",
            ExitCode.FREEZE,
        )


def _refuse_undeveloped(take: PlannedTake) -> None:
    """Raises JobError if an instant is not stored in the run's folder: instants developed per part would not match."""
    lacking = [int(t) for t in take.spec.instants.keys if not take.spec.instants.is_stored(t)]
    if lacking:
        raise JobError(
            f"The developed instant {lacking[0]} is missing from the run.",
            "Run the step `open` again: it reports why the instant cannot be saved.",
            ExitCode.FREEZE,
        )
