"""`python -m torch_backend.tied MODULE ARGUMENTS...`: runs MODULE, and ends when the process that started it ends.

The launcher starts the backend, venv and pip this way, so that none of them outlives a launcher that is killed.
Blender's jobs are not tied to Blender. Standard library only: any Python of the machine may run it.
"""

from __future__ import annotations

import runpy
import sys

from .contract import end_with_starter

if __name__ == "__main__":
    end_with_starter()
    sys.argv = sys.argv[1:]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
