"""A run trained anew in the name of one that is there: beside it, and in its place only when it is done.

runs/<name>/next/<key>/ holds what a run's folder holds, one folder for each set of settings that was begun, so neither
a finished run nor hours of a paused one go before there is another. Inside of the run's own folder it is part of the
run: it is not listed as a run, and is removed with the run.
"""

from __future__ import annotations

import shutil
from pathlib import Path

from ..contract import CONFIG_FILE, DEPTH_FILE, METRICS_FILE, NEXT_FOLDER, PREVIEWS_FOLDER, is_link, remove_link
from ..contract import SUMMARY_FILE as SUMMARY_FILE
from ..shot import remove_file, replace_file
from .checkpoint import CHECKPOINT_FILE, read_meta
from .extend import EXTENSION_FILE


def folder_for(run: Path, key: str, resume: bool) -> Path:
    """The folder in which settings of a key are trained: the run's own if it holds nothing else, or has begun them."""
    folder = begun(run, key) if resume else None
    if folder is not None:
        return folder
    return run / NEXT_FOLDER / key if (run / CHECKPOINT_FILE).is_file() else run


def begun(run: Path, key: str) -> Path | None:
    """The folder in which settings of a key were begun, or finished; None if nowhere."""
    for place in (run, run / NEXT_FOLDER / key):
        checkpoint = place / CHECKPOINT_FILE
        if checkpoint.is_file() and read_meta(checkpoint).get("key") == key:
            return place
    return None


def replace_run(run: Path, done: Path) -> None:
    """Moves what was trained in `done`, a folder of `folder_for`, to the run's own; nothing else that was begun stays.

    Every file is replaced atomically, the checkpoint first, so that a freeze reads either the old run or the new one.
    `finish_replacing` goes on where a killed process stopped.
    """
    if not (done / DEPTH_FILE).is_file() and (done / CHECKPOINT_FILE).is_file():  # else a killed process has moved it
        remove_file(run / DEPTH_FILE)
    for name in (CHECKPOINT_FILE, DEPTH_FILE, CONFIG_FILE, METRICS_FILE):
        if (done / name).is_file():
            replace_file(done / name, run / name)
    if (done / PREVIEWS_FOLDER).is_dir():
        shutil.rmtree(run / PREVIEWS_FOLDER, ignore_errors=True)
        replace_file(done / PREVIEWS_FOLDER, run / PREVIEWS_FOLDER)
    remove_file(run / EXTENSION_FILE)
    replace_file(done / SUMMARY_FILE, run / SUMMARY_FILE)
    shutil.rmtree(run / NEXT_FOLDER, ignore_errors=True)


def finish_replacing(run: Path) -> None:
    """Goes on with a `replace_run` that was killed halfway."""
    if is_link(run / NEXT_FOLDER):  # none of ours: a shot folder may come from anywhere
        remove_link(run / NEXT_FOLDER)
    for summary in sorted((run / NEXT_FOLDER).glob(f"*/{SUMMARY_FILE}")):
        if is_link(summary.parent):
            remove_link(summary.parent)
        else:
            replace_run(run, summary.parent)


def drop_begun(run: Path, key: str) -> None:
    """Drops what was begun of settings that the run itself is finished with: it could only come to the same."""
    shutil.rmtree(run / NEXT_FOLDER / key, ignore_errors=True)
