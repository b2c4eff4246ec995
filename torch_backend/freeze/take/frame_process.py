"""Worker process of `side_by_side.py`: `python -m torch_backend.freeze.take.frame_process`.

Reads one message (`contract.read_message`) from standard input. Its header is the request: `shot`, `params` of the
freeze, `t_star`, `keys` of the whole take, `folder` for the frames, and `frames`, the numbers to render. The input
stays open as long as the starter lives. Writes these messages to standard output:

| kind | content |
|---|---|
| `progress` | `done`: number of finished frames of this process; `message`: the current frame |
| `share` | `frame`, `size` [h, w]; body: float32, the frame's share of plate, as `render_frames` returns it |
| `error` | `message`, `hint`, `exit_code` of a `JobError` |

If the take differs from the starter's, because the run was trained meanwhile, the process exits without a message.
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
    working_on,
    write_message,
)


class _FrameReporter(Reporter):
    """Sends the progress of the frames. Warnings are dropped, because the starter has already reported them."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream

    def progress(self, stage: str, done: float, total: float, message: str = "") -> None:
        """Sends the progress of the stage `freezing` only."""
        if stage == "freezing" and done < total:
            write_message(self._stream, {"kind": "progress", "done": int(done), "message": message})


def main() -> int:
    """Runs the request and returns an `ExitCode`."""
    with os.fdopen(0, "rb", buffering=0, closefd=False) as stdin:
        message = read_message(stdin)
    end_with_starter()
    stream = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # libraries print to stderr instead of the message stream
    if message is None:
        return ExitCode.CANCELLED
    try:
        with working_on(Path(message[0]["shot"])):
            _render(message[0], stream)
    except KeyboardInterrupt:
        return ExitCode.CANCELLED
    except (JobError, OSError) as error:
        known = error if isinstance(error, JobError) else path_error(error)
        if known is None:
            raise
        header = {"kind": "error", "message": known.message, "hint": known.hint, "exit_code": int(known.exit_code)}
        write_message(stream, header)
        return known.exit_code
    return ExitCode.OK


def _render(request: dict[str, Any], stream: BinaryIO) -> None:
    from ...shot import Shot  # importing torch takes seconds, during which stdin must already be watched
    from .frames import render_frames
    from .plan import planned

    report, shot = _FrameReporter(stream), Shot.open(request["shot"])
    params = from_dict(FreezeParams, request["params"])
    take = planned(shot, params, report, request["t_star"])
    if take.all_keys != request["keys"]:
        return
    requested = set(request["frames"])
    take = dataclasses.replace(take, folder=TakeFolder(shot.own(Path(request["folder"]))))
    frames = [output for output in take.whole if output.frame in requested]
    for frame, share in render_frames(take, frames, set(), report).items():
        header = {"kind": "share", "frame": frame, "size": list(share.shape)}
        write_message(stream, header, share.contiguous().numpy().tobytes())


if __name__ == "__main__":
    sys.exit(main())
