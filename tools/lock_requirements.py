"""Regenerates requirements/*.lock: all packages of a set-up, pinned, with the SHA-256 of their wheels.

    python -m venv /tmp/lock && /tmp/lock/bin/pip install uv
    python3 tools/lock_requirements.py --uv /tmp/lock/bin/uv

A `.txt` in requirements/ is edited by hand: it lists direct requirements; constraints.txt limits their dependencies.
Its `.lock` is complete: pip installs it with `--no-deps --require-hashes`. backend.txt becomes several locks, because
torch is installed separately, and its CUDA libraries only if the installed torch requires them.

uv queries PyPI. Builds of torch on download.pytorch.org are locked from TORCH_WHEELS, one lock per build.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
from pathlib import Path

REQUIREMENTS = Path(__file__).resolve().parent.parent / "requirements"
PYTHONS = {"bpy-5.2": "3.13"}
"""Lowest Python of a lock if it is not 3.11."""
WITHOUT_DEPENDENCIES = ("bench",)
"""Lists that name every package explicitly (see their first lines)."""
CUDA = re.compile(r"(nvidia|cuda|triton)\b")
"""Pattern for names of packages that only torch with CUDA needs."""

TORCH_WHEELS = {
    # The CPU build for Linux. The hash of cp311 x86_64 was computed from the file. Each other hash was found in at
    # least two public repositories on 29 November 2026, because the project's machines cannot reach torch's index.
    "torch-2.13.0+cpu-cp311-cp311-manylinux_2_28_x86_64.whl": (
        "6746dbcbeb526eb61330b76b41ff1b4eb848951103a892eeb080dfa2b264667b"
    ),
    "torch-2.13.0+cpu-cp312-cp312-manylinux_2_28_x86_64.whl": (
        "4ca4a9394b0c771238a4f73590fdbbc4debad85ed0fa63d026ae1b085da7d6e2"
    ),
    "torch-2.13.0+cpu-cp313-cp313-manylinux_2_28_x86_64.whl": (
        "3fbf9c9d1f3c10c2d59d04aca426dee9ccc6ceb32d255c61e93acc3b4f75fae6"
    ),
    "torch-2.13.0+cpu-cp314-cp314-manylinux_2_28_x86_64.whl": (
        "d20fa53ee744502fa4c69818a720b05ca0d37abd055d4f6e66cae155114bc691"
    ),
    "torch-2.13.0+cpu-cp311-cp311-manylinux_2_28_aarch64.whl": (
        "84453b69508ec79902f899c5ed9495acb9e2bbe9fda5f1d5d6f19e3c3842e1a7"
    ),
    "torch-2.13.0+cpu-cp312-cp312-manylinux_2_28_aarch64.whl": (
        "6f307c2c32d764ffc6ff6893b801fad6d4752f3e67966cb8abf1843427c02604"
    ),
    "torch-2.13.0+cpu-cp313-cp313-manylinux_2_28_aarch64.whl": (
        "0b8f7d0423027ae8b90c7977c627f3379f325363a08224dffad9b4b2d684a83d"
    ),
    "torch-2.13.0+cpu-cp314-cp314-manylinux_2_28_aarch64.whl": (
        "ca021f9eb2f8345c83fa03e3a04587308afb8df71bd472670b3ece00df58621c"
    ),
    # The CUDA build for Windows. The wheel of cp311 is missing, because no two sources of its hash were found. A set-up
    # with that Python prints that torch has no hash (`launcher.environments.torch_lock`).
    "torch-2.13.0+cu130-cp312-cp312-win_amd64.whl": "2efab1e83604ca628c6d85b9e188c153690980498d1297081a9dad704919303c",
    "torch-2.13.0+cu130-cp313-cp313-win_amd64.whl": "cf23236e9deed7d3510d14d9b9592d75d272ef7b35bbfee31a02bea339c73971",
    "torch-2.13.0+cu130-cp314-cp314-win_amd64.whl": "590b2a2b53ef295dcfcd703df17929bd579705bb0e42d9e43c462fe0f0b1e088",
}


def main() -> int:
    """Writes every lock; returns an exit code."""
    parser = argparse.ArgumentParser(description="Regenerate requirements/*.lock.")
    parser.add_argument("--uv", default="uv", help="uv's program")
    uv = parser.parse_args().uv
    for path in sorted(REQUIREMENTS.glob("*.txt")):
        if path.stem == "constraints":
            continue
        entries = compiled(uv, path)
        if path.stem == "backend":
            torch = [e for e in entries if name_of(e) == "torch"]
            write("torch", torch)
            for build in ("cpu", "cu130"):
                write(f"torch-{build}", *of_build(torch[0].split()[0], build))
            write("cuda", [e for e in entries if CUDA.match(name_of(e))])
            entries = [e for e in entries if name_of(e) != "torch" and not CUDA.match(name_of(e))]
        write(path.stem, entries)
    return 0


def compiled(uv: str, path: Path) -> list[str]:
    """Entries of a lock that uv computes from a list of requirements: one per package, including its hashes."""
    command = [uv, "pip", "compile", "-q", "--universal", "--generate-hashes", "--no-header", "--no-annotate"]
    command += ["--only-binary", ":all:", "--python-version", PYTHONS.get(path.stem, "3.11")]
    command += ["--no-deps"] if path.stem in WITHOUT_DEPENDENCIES else []
    # Packages of tests and benchmarks are installed into the backend's environment.
    command += ["-c", "backend.txt"] if path.stem in ("test", "bench") else []
    done = subprocess.run([*command, path.name], cwd=path.parent, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(done.stderr)
    return re.findall(r"^\S.*(?:\n\s.*)*", done.stdout, re.M)


def name_of(entry: str) -> str:
    """Name of an entry's package."""
    return entry.partition("==")[0]


def of_build(pin: str, build: str) -> tuple[list[str], str]:
    """Entry and notes for a build of torch's index. The launcher searches the notes for a wheel's file name."""
    wheels = {name: digest for name, digest in TORCH_WHEELS.items() if f"+{build}-" in name}
    entry = " \\\n".join([f"{pin}+{build}", *(f"    --hash=sha256:{digest}" for digest in wheels.values())])
    return [entry], "".join(f"#   {digest}  {name}\n" for name, digest in wheels.items())


def write(stem: str, entries: list[str], notes: str = "") -> None:
    """Writes requirements/STEM.lock."""
    head = f"# Made by tools/lock_requirements.py. Do not edit.\n{notes}"
    (REQUIREMENTS / f"{stem}.lock").write_text(head + "".join(f"{e}\n" for e in entries), encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
