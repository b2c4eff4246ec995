"""Entry point of the child process in which COLMAP runs: `python -m torch_backend.sfm.start_worker REQUEST.json`.

It is separate from `worker.py`, which imports pycolmap, so that it can report a missing or broken package as one line
of JSON, {"lacks": "Python's message"}, instead of as a failed solve.
"""

from __future__ import annotations

import json
import sys
import traceback

from ..contract import ExitCode


def main(path: str) -> int:
    """Runs `worker.main` on a request file; returns ENVIRONMENT if a package that it needs cannot be loaded."""
    try:
        from . import worker
    except Exception as error:  # a half-written package can raise any exception
        is_ours = isinstance(error, ImportError) and (error.name or "").startswith("torch_backend")
        if is_ours or isinstance(error, MemoryError):
            raise
        traceback.print_exc()
        message = str(error) if isinstance(error, ImportError) else f"{type(error).__name__}: {error}"
        sys.stdout.write(json.dumps({"lacks": message}) + "\n")
        sys.stdout.flush()
        return ExitCode.ENVIRONMENT
    return worker.main(path)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1]))
