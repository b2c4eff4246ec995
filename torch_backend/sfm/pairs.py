"""Matches listed image pairs in several processes, because OpenBLAS in pycolmap's wheel is not thread-safe.

One thread of each process matches and another verifies. The matches of a pair depend only on its two images: any number
of processes makes the same database, to the byte.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

import pycolmap

from ..contract import REQUEST_FILE, python_child
from . import colmap_types as colmap
from .request import SEED, Request, closing_database, say

MOST_PROCESSES = 4
"""Upper limit of processes: each needs a copy of the database (0.5 MB a frame) and its own search trees."""

LEAST_PAIRS = 100
"""Smallest number of pairs per process. The start of a process takes about a second, a pair 12 to 30 ms."""

BLOCK = 64
"""Pairs after which COLMAP reports progress and drops its search trees. 405 pairs take 9.5 CPU seconds in blocks of 8,
7.6 in blocks of 64 or 1024."""


def match_pairs(request: Request, pairs: Mapping[str, Sequence[str]], stage: str = "other matches") -> None:
    """Matches each image with its listed images. Matches that are already in the database are kept."""
    say(stage=stage)
    lines = [f"{name} {partner}" for name, partners in pairs.items() for partner in partners]
    count = max(1, min(request.threads, MOST_PROCESSES, len(lines) // LEAST_PAIRS))
    parts = [lines[len(lines) * n // count : len(lines) * (n + 1) // count] for n in range(count)]
    if not lines:  # a single frame
        return
    with ExitStack() as stack:
        helpers = [stack.enter_context(_Helper(request, part, n)) for n, part in enumerate(parts[1:], start=1)]
        match_lines(request, parts[0])
        left = [line for helper in helpers if not helper.done() for line in helper.lines]
    if left:  # pairs of a helper that failed, for example for lack of memory
        match_lines(request, left)


def match_lines(request: Request, lines: Sequence[str]) -> None:
    """Matches the pairs "name other" in this process."""
    listing = request.scratch / "pairs.txt"
    listing.write_text("\n".join(lines) + "\n", encoding="utf-8")
    geometry = pycolmap.TwoViewGeometryOptions()
    geometry.ransac.random_seed = SEED
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = listing
    pairing.block_size = BLOCK
    colmap.match_image_pairs(request.database, one_thread(), pairing, geometry)


def one_thread() -> pycolmap.FeatureMatchingOptions:
    """Matching options: one thread, no GPU."""
    options = pycolmap.FeatureMatchingOptions()
    options.use_gpu = False
    # In pycolmap 4.2.1, two threads that call sgemm at once get wrong products: 18 of 15,000 calls, 0 of 6000 from one.
    # Two pairs then lost half of their matches, and the cameras differed.
    options.num_threads = 1
    return options


class _Helper:
    """A child process that matches a part of the pairs in a copy of the database. A `with` block removes both."""

    def __init__(self, request: Request, lines: Sequence[str], number: int) -> None:
        self.lines, self._request = lines, request
        self._folder = request.scratch / f"pairs_{number}"

    def __enter__(self) -> _Helper:
        self._folder.mkdir()
        shutil.copyfile(self._request.database, self._folder / self._request.database.name)
        file = self._folder / REQUEST_FILE
        file.write_text(json.dumps({**self._request.data, "match": self.lines}), encoding="utf-8")
        command = python_child(sys.executable, "torch_backend.sfm.start_worker", str(file))
        # The helper ends when its input closes, so it does not outlive this process.
        self._process = subprocess.Popen(**command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL)
        return self

    def __exit__(self, *_: object) -> None:
        if self._process.poll() is None:
            self._process.kill()
        self._process.communicate()
        shutil.rmtree(self._folder, ignore_errors=True)

    def done(self) -> bool:
        """Waits for the process and copies its matches; False if it failed."""
        if self._process.wait() != 0:
            return False
        ids = _ids(self._request.database)
        pairs = [(ids[one], ids[second]) for one, second in (line.split(" ") for line in self.lines)]
        part = colmap.open_database(self._folder / self._request.database.name)
        with closing_database(self._request) as database, pycolmap.DatabaseTransaction(database):
            for pair in pairs:
                if part.exists_matches(*pair) and not database.exists_matches(*pair):
                    database.write_matches(*pair, part.read_matches(*pair))
                if part.exists_two_view_geometry(*pair) and not database.exists_two_view_geometry(*pair):
                    database.write_two_view_geometry(*pair, part.read_two_view_geometry(*pair))
        part.close()
        return True


def _ids(file: Path) -> dict[str, int]:
    database = colmap.open_database(file)
    try:
        return {image.name: image.image_id for image in database.read_all_images()}
    finally:
        database.close()
