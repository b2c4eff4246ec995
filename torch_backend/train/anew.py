"""Retraining of an existing run: the new run is trained in a separate folder and replaces the old one at its end.

runs/<name>/next/<key>/ has the contents of a run folder, with one folder per set of settings. A finished or paused run
is therefore kept until the new one is finished. The folders are part of the run: they are not listed as runs, and are
removed with the run.
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
    """Training folder for the settings with key `key`.

    With `resume`, it is the folder of a training that was begun with these settings. Otherwise it is the run's folder
    if that has no checkpoint, else a folder in `NEXT_FOLDER`.
    """
    folder = begun(run, key) if resume else None
    if folder is not None:
        return folder
    return run / NEXT_FOLDER / key if (run / CHECKPOINT_FILE).is_file() else run


def begun(run: Path, key: str) -> Path | None:
    """Folder with a checkpoint of the settings with key `key`; None if there is none."""
    for place in (run, run / NEXT_FOLDER / key):
        checkpoint = place / CHECKPOINT_FILE
        if checkpoint.is_file() and read_meta(checkpoint).get("key") == key:
            return place
    return None


def replace_run(run: Path, done: Path) -> None:
    """Moves the run trained in `done`, a folder of `folder_for`, to the run's folder. Removes unfinished trainings.

    Every file is replaced atomically. `finish_replacing` resumes after a killed process.
    """
    # Without the checkpoint in `done`, a killed process may already have moved the depth file.
    if not (done / DEPTH_FILE).is_file() and (done / CHECKPOINT_FILE).is_file():
        remove_file(run / DEPTH_FILE)
    # The checkpoint first, so that a freeze reads either the old run or the new one.
    for name in (CHECKPOINT_FILE, DEPTH_FILE, CONFIG_FILE, METRICS_FILE):
        if (done / name).is_file():
            replace_file(done / name, run / name)
    if (done / PREVIEWS_FOLDER).is_dir():
        shutil.rmtree(run / PREVIEWS_FOLDER, ignore_errors=True)
        replace_file(done / PREVIEWS_FOLDER, run / PREVIEWS_FOLDER)
    remove_file(run / EXTENSION_FILE)
    # Last, because `finish_replacing` recognises an unfinished replacement by this file.
    replace_file(done / SUMMARY_FILE, run / SUMMARY_FILE)
    shutil.rmtree(run / NEXT_FOLDER, ignore_errors=True)


def finish_replacing(run: Path) -> None:
    """Completes a `replace_run` that was killed."""
    if is_link(run / NEXT_FOLDER):  # never created by this package: the shot folder may come from an untrusted source
        remove_link(run / NEXT_FOLDER)
    for summary in sorted((run / NEXT_FOLDER).glob(f"*/{SUMMARY_FILE}")):
        if is_link(summary.parent):
            remove_link(summary.parent)
        else:
            replace_run(run, summary.parent)


def drop_begun(run: Path, key: str) -> None:
    """Removes an unfinished training with the settings of the finished run, whose result would be the same."""
    shutil.rmtree(run / NEXT_FOLDER / key, ignore_errors=True)
