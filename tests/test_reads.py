"""Files of shots and footage are checked before they are read.

A pipe would block a program forever; a device or a sparse file would fill its memory. The contract's `open_regular`,
`open_arrays` and `regular_file` do the check.
"""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
LOOKS = {"open_regular", "open_arrays", "regular_file"}
OPENS = {"ImageInput.open", "ImageBuf", "images.load", "av.open", "safe_open", "np.load", "np.fromfile", "cv2.imread"}
"""Ends of the names of functions that open a file by its path, or read an open file."""
TRUSTED_READS = {
    "torch_backend/kernel_text.py": "the package's own files",
    "torch_backend/contract/hosts.py": "the package's own files",
    "torch_backend/contract/processes.py": "/proc and /etc",
    "torch_backend/contract/files.py": "it is what looks",
    "torch_backend/sfm/child.py": "the log of a child that this process started, opened by it",
    "torch_backend/sfm/request.py": "what the parent wrote into the scratch folder that it made",
    "torch_backend/sfm/results.py": "what the child wrote into the scratch folder that was made for it",
    "torch_backend/lens/undistort_first.py": "the same scratch folder",
    "torch_backend/footage/images.py:_has_end": "a picture that this process has just written",
    "torch_backend/contract/writing.py": "files that this process writes",
    "splannequin_addon/process/environment.py": "the log of a set-up that this Blender started",
}
"""Modules, or single functions, that may read without a check, with the reason."""


def unseen(source: str) -> Iterator[tuple[str, str]]:
    """(function, call) of each call in a module that opens a file by its path without a check."""
    tree = ast.parse(source)
    inside = {
        id(node): scope.name
        for scope in ast.walk(tree)
        if isinstance(scope, ast.FunctionDef)
        for node in ast.walk(scope)
    }
    looked = {
        item.optional_vars.id
        for node in ast.walk(tree)
        if isinstance(node, ast.With)
        for item in node.items
        if isinstance(item.optional_vars, ast.Name)
        and isinstance(item.context_expr, ast.Call)
        and ast.unparse(item.context_expr.func).rpartition(".")[2] in LOOKS
    }
    # A checked path may have been assigned to a name before.
    looked |= {
        node.targets[0].id
        for node in ast.walk(tree)
        if isinstance(node, ast.Assign)
        and isinstance(node.targets[0], ast.Name)
        and any(f"{name}(" in ast.unparse(node.value) for name in LOOKS)
    }
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        name, first = ast.unparse(node.func), ast.unparse(node.args[0]) if node.args else ""
        modes = [a.value for a in [*node.args[1:2], *(k.value for k in node.keywords if k.arg == "mode")]
                 if isinstance(a, ast.Constant)]  # fmt: skip
        writes = any(isinstance(mode, str) and set(mode) & set("wax+") for mode in modes)
        by_path = any(name == end or name.endswith(f".{end}") for end in OPENS) or name == "open"
        opens = (by_path and not writes) or name.rpartition(".")[2] in ("read_text", "read_bytes")
        # ImageBuf of pixels or of a specification opens no file.
        if name.endswith("ImageBuf") and first.startswith(("np.", "spec", "sheet")):
            opens = False
        if opens and not any(f"{look}(" in first for look in LOOKS) and first not in looked:
            yield inside.get(id(node), ""), ast.unparse(node)


def modules() -> list[Path]:
    found = [*(ROOT / "torch_backend").rglob("*.py"), *(ROOT / "splannequin_addon").rglob("*.py")]
    return sorted(p for p in found if "report" not in p.relative_to(ROOT).parts)


@pytest.mark.parametrize("path", modules(), ids=lambda path: path.relative_to(ROOT).as_posix())
def test_files_are_looked_at_before_they_are_read(path: Path):
    where = path.relative_to(ROOT).as_posix()
    if where not in TRUSTED_READS:
        found = [
            call for scope, call in unseen(path.read_text(encoding="utf-8")) if f"{where}:{scope}" not in TRUSTED_READS
        ]
        assert not found, "ask `regular_file`, `open_regular` or `open_arrays` of the contract first"


@pytest.mark.parametrize(
    ("source", "count"),
    [
        ("oiio.ImageInput.open(str(path))", 1),
        ("oiio.ImageInput.open(regular_file(path))", 0),
        ("bpy.data.images.load(wanted)", 1),
        ("bpy.data.images.load(contract.regular_file(wanted))", 0),
        ("with open(path, 'rb') as f:\n    f.read()", 1),
        ("with open(path, 'wb') as f:\n    f.write(b'')", 0),
        ("with open_arrays(path) as f, np.load(f) as arrays:\n    pass", 0),
        ("np.load(path)", 1),
        ("path.read_bytes()", 1),
        ("oiio.ImageBuf(np.zeros(3))", 0),
    ],
)
def test_the_scan_sees_what_opens(source: str, count: int):
    assert len(list(unseen(source))) == count
