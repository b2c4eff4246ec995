"""Locations of the project's files, and the operating system. Runs under Python 3.8."""

from __future__ import annotations

import os
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
"""The checkout, or the folder of the installed extension."""
REQUIREMENTS = ROOT / "requirements"
DEMO_CLIP = ROOT / "examples" / "sitting.mp4"
WINDOWS = os.name == "nt"
LINUX = sys.platform.startswith("linux")
WORKING_FOLDER = Path()
"""The user's working folder, for children that receive paths as the user typed them."""
