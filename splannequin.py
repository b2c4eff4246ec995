#!/usr/bin/env python3
"""Splannequin's launcher: makes the two environments the project needs, then runs it. Standard library only.

    python3 splannequin.py demo                     freeze the bundled clip
    python3 splannequin.py freeze CLIP --t-star 40  freeze your own; a shot folder in its place: freeze that anew
    python3 splannequin.py doctor                   what this machine can do
    python3 splannequin.py test                     all tests
    python3 splannequin.py bench --quick            the method against ground truth, with a report
    python3 splannequin.py farm export SHOT ...     a job for a render farm (docs/farm.md)
    python3 splannequin.py setup                    make the environments and stop

The backend lives in `.venv`; Blender as a Python module lives in `.venv-bpy-X.Y` (their numpy versions exclude each
other). Both stand beside this file, or in the folder that SPLANNEQUIN_HOME names. Exit codes:
docs/manual/troubleshooting.md.

This file and what it imports at its top run under Python 3.8, so that an old Python can say which one is needed.
"""

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent
if str(ROOT) not in sys.path:  # -P and PYTHONSAFEPATH leave even a script's own folder out
    sys.path.insert(0, str(ROOT))

from launcher.interpreters import NEEDED_PYTHON, hand_over_to_newer_python  # noqa: E402

if __name__ == "__main__":
    if sys.version_info[:2] < NEEDED_PYTHON:
        sys.exit(hand_over_to_newer_python())
    from launcher.main import main

    sys.exit(main())
