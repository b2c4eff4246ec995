"""Starts the child process in which COLMAP runs: `python -m torch_backend.sfm.start_worker REQUEST.json`.

Apart from `worker.py`, which loads pycolmap before its first line: a package that is missing or broken is told as one
line of JSON, {"lacks": "what Python says of it"}, and not as a solve that broke.
"""

from __future__ import annotations

import json
import sys
import traceback

from ..contract import ExitCode


def main(path: str) -> int:
    """Runs the request of a file as `worker.main`; ENVIRONMENT if what that needs cannot be loaded."""
    try:
        from . import worker
    except Exception as error:  # a package that was half written raises anything
        ours = isinstance(error, ImportError) and (error.name or "").startswith("torch_backend")
        if ours or isinstance(error, MemoryError):
            raise
        traceback.print_exc()
        message = str(error) if isinstance(error, ImportError) else f"{type(error).__name__}: {error}"
        sys.stdout.write(json.dumps({"lacks": message}) + "\n")
        sys.stdout.flush()
        return ExitCode.ENVIRONMENT
    return worker.main(path)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1]))
