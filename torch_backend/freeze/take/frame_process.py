"""One of the processes of `side_by_side.py`: `python -m torch_backend.freeze.take.frame_process`.

On its standard input comes one message of `contract.read_message`, whose header is the request: `shot`, `params` (of
the freeze), `t_star`, `keys` of the whole take, `folder` for the frames, and `frames`, the numbers of those to render.
The input stays open as long as the starter lives. On the standard output go messages:

| kind | with |
|---|---|
| `progress` | `done` frames of this process, `message` of that at work |
| `share` | `frame`, `size` [h, w]; the body: float32, the frame's share of plate, as `render_frames` returns it |
| `error` | `message`, `hint`, `exit_code` of a `JobError` |

Where it would render something else than its starter, because the run has been trained meanwhile, it ends in silence.
"""

from __future__ import annotations

import dataclasses
import os
import sys
from pathlib import Path
from typing import Any, BinaryIO

from ...contract import (
    ExitCode,
    FreezeParams,
    JobError,
    Reporter,
    TakeFolder,
    end_with_starter,
    from_dict,
    path_error,
    read_message,
    write_message,
)


class _Told(Reporter):
    """Says how far the frames are; the starter has said all else."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream

    def progress(self, stage: str, done: float, total: float, message: str = "") -> None:
        """Frames alone."""
        if stage == "freezing" and done < total:
            write_message(self._stream, {"kind": "progress", "done": int(done), "message": message})


def main() -> int:
    """Runs the request; an `ExitCode`."""
    with os.fdopen(0, "rb", buffering=0, closefd=False) as stdin:
        asked = read_message(stdin)
    end_with_starter()
    stream = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever a library prints is no message
    if asked is None:
        return ExitCode.CANCELLED
    try:
        _render(asked[0], stream)
    except KeyboardInterrupt:
        return ExitCode.CANCELLED
    except (JobError, OSError) as error:
        told = error if isinstance(error, JobError) else path_error(error)
        if told is None:
            raise
        header = {"kind": "error", "message": told.message, "hint": told.hint, "exit_code": int(told.exit_code)}
        write_message(stream, header)
        return told.exit_code
    return ExitCode.OK


def _render(request: dict[str, Any], stream: BinaryIO) -> None:
    from ...shot import Shot  # torch takes seconds, in which the input must be watched already
    from .frames import render_frames
    from .plan import planned

    told, shot = _Told(stream), Shot.open(request["shot"])
    params = from_dict(FreezeParams, request["params"])
    take = planned(shot, params, told, request["t_star"])
    if take.all_keys != request["keys"]:
        return
    wanted = set(request["frames"])
    take = dataclasses.replace(take, folder=TakeFolder(shot.own(Path(request["folder"]))))
    frames = [output for output in take.whole if output.frame in wanted]
    for frame, share in render_frames(take, frames, set(), told).items():
        header = {"kind": "share", "frame": frame, "size": list(share.shape)}
        write_message(stream, header, share.contiguous().numpy().tobytes())


if __name__ == "__main__":
    sys.exit(main())
