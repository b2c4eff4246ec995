"""Takes each remedy out of the rasteriser, one at a time, and asks whether a test notices.

    python tests/backend/raster/remedies.py [WORD ...]      only remedies whose name, symbol or test holds a WORD

Works on a copy in a temporary folder. First every named test must pass on the unchanged copy; then, for each remedy,
its text is replaced and its test must fail. Exit code 1 if one does not notice, or if a text is no longer there, or if
a test that stands for a known failure has no remedy here. test_hard_cases.py checks the last two.

The remedies stand in `remedies_cpu.py`, `remedies_reference.py` and `remedies_cuda.py`, each named by the function or
the kernel that it is in; `tests/proofs.py` finds it there wherever that has moved.
"""

import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]
if str(Path(__file__).parent) not in sys.path:
    sys.path.insert(0, str(Path(__file__).parent))

import remedies_cpu  # noqa: E402  # pyright: ignore[reportMissingImports]
import remedies_cuda  # noqa: E402  # pyright: ignore[reportMissingImports]
import remedies_reference  # noqa: E402  # pyright: ignore[reportMissingImports]
from remedy import Remedy  # noqa: E402  # pyright: ignore[reportMissingImports]

REMEDIES: list[Remedy] = [*remedies_cpu.REMEDIES, *remedies_reference.REMEDIES, *remedies_cuda.REMEDIES]
COPIED = ("torch_backend", "tests", "benchmarks", "examples", "pyproject.toml")


def without_remedy() -> list[str]:
    """Tests, file::function, that stand for a known failure or are a property of every input, but have no remedy."""
    if str(ROOT) not in sys.path:
        sys.path.insert(0, str(ROOT))
    from benchmarks.known_failures import ROWS
    from benchmarks.numerics import test_names

    named = {test for _, tests, _ in ROWS for test in tests}
    named |= {test for test in test_names() if test.startswith("test_properties.py::test_")}
    return sorted(named - {remedy.full_test for remedy in REMEDIES})


def _either(bodies: set[str]) -> str:
    """pytest's -k for tests of any of the bodies, and those of none."""
    unwanted = {"cpu", "reference", "cuda", "gpu"} - {body.removesuffix("32") for body in bodies}
    return " and ".join(f"not {body}" for body in sorted(unwanted))


def _run(folder: Path, arguments: list[str]) -> subprocess.CompletedProcess[str]:
    environment = {
        **os.environ,
        "WARP_CACHE_PATH": str(folder / "kernels"),
        "PYTHONPATH": str(folder),
        "SPLANNEQUIN_NO_SHRINK": "1",
    }
    command = [sys.executable, "-P", "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "--tb=line", *arguments]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=900)


def _try(folder: Path, remedy: Remedy) -> str:
    """Take one remedy out, run its test, put it back. What happened, in a word; 'noticed' is what should."""
    try:
        changed = remedy.made(folder)
    except LookupError as error:
        return f"NOT THERE: {error}"
    texts = {path: path.read_text(encoding="utf-8") for path in changed}
    try:
        for path, text in changed.items():
            path.write_text(text, encoding="utf-8")
        code = _run(folder, remedy.command).returncode
    finally:
        for path, text in texts.items():
            path.write_text(text, encoding="utf-8")
    # 1: tests failed; below 0: the process died, as an out-of-bounds access makes it.
    return "noticed" if code == 1 or code < 0 else f"NOT NOTICED (pytest's exit code {code})"


def main(words: list[str]) -> int:
    chosen = [r for r in REMEDIES if not words or any(w in f"{r.name} {r.symbol} {r.test} {r.body}" for w in words)]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for item in COPIED:
            source = ROOT / item
            if source.is_dir():
                shutil.copytree(source, folder / item, ignore=shutil.ignore_patterns("__pycache__"))
            elif source.exists():
                shutil.copy2(source, folder / item)
        run = _run(folder, [*dict.fromkeys(r.node for r in chosen), "-k", _either({r.body for r in chosen})])
        if run.returncode:
            print(f"fails before anything is taken out:\n{run.stdout[-3000:]}{run.stderr[-1000:]}")
            return 1
        bad = 0
        for remedy in chosen:
            start = time.monotonic()
            verdict = _try(folder, remedy)
            bad += verdict != "noticed"
            print(
                f"{verdict:12s} {time.monotonic() - start:5.0f} s  {remedy.symbol}: {remedy.name}  [{remedy.test}, "
                f"{remedy.body or 'no body'}]",
                flush=True,
            )
    print(f"{len(chosen) - bad} of {len(chosen)} remedies: their test fails without them")
    missing = without_remedy()
    print(f"tests of known failures and properties that have no remedy: {', '.join(missing) or 'none'}")
    return int(bad > 0 or bool(missing))


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
