#!/usr/bin/env python3
"""Splannequin's launcher: sets up the project's two environments, then runs it. Needs only the standard library.

    python3 splannequin.py demo                     freeze the bundled clip
    python3 splannequin.py freeze CLIP --t-star 40  freeze your own clip, or a shot folder again
    python3 splannequin.py doctor                   what this machine can do
    python3 splannequin.py test                     all tests
    python3 splannequin.py bench --quick            the method against ground truth, with a report
    python3 splannequin.py farm export SHOT ...     a job for a render farm (docs/farm.md)
    python3 splannequin.py setup                    set up the environments and stop

The backend is in `.venv`, Blender as a Python module in `.venv-bpy-X.Y`, because their numpy versions are incompatible.
Both are in this file's folder, or in the folder of SPLANNEQUIN_HOME. Exit codes: docs/manual/troubleshooting.md.

This file and its imports run under Python 3.8, so that an old Python can report which version is needed.
"""

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent
if str(ROOT) not in sys.path:  # -P and PYTHONSAFEPATH exclude the script's folder
    sys.path.insert(0, str(ROOT))

from launcher.interpreters import NEEDED_PYTHON, hand_over_to_newer_python  # noqa: E402

if __name__ == "__main__":
    if sys.version_info[:2] < NEEDED_PYTHON:
        sys.exit(hand_over_to_newer_python())
    from launcher.main import main

    sys.exit(main())
