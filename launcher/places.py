"""Where the project's files are, and what the system is. Runs under Python 3.8."""

from __future__ import annotations

import os
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
"""The checkout, or the folder that the extension is installed in."""
REQUIREMENTS = ROOT / "requirements"
DEMO_CLIP = ROOT / "examples" / "sitting.mp4"
WINDOWS = os.name == "nt"
LINUX = sys.platform.startswith("linux")
HERE = Path()
"""Where the user stands, for children that are given paths as they were typed."""
