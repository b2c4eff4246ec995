"""Names of the deformation hosts, read from their source files, so that help and panel need not import torch."""

from __future__ import annotations

import ast
import functools
from pathlib import Path

_FOLDER = Path(__file__).resolve().parents[1] / "deformation"


@functools.cache
def host_names(folder: Path = _FOLDER) -> tuple[str, ...]:
    """Names of the hosts in a folder: first argument or `name=` of the `HOST = HostSpec(...)` of each module."""
    found: set[str] = set()
    for file in folder.glob("*.py"):
        source = file.read_text(encoding="utf-8")
        if "\nHOST" in source:
            found |= {name for node in ast.parse(source).body if (name := _name_of(node))}
    return tuple(sorted(found))


def _name_of(node: ast.stmt) -> str:
    """Host name in a statement that assigns a module's HOST; empty for any other statement."""
    targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
    call = getattr(node, "value", None)
    if not any(isinstance(t, ast.Name) and t.id == "HOST" for t in targets) or not isinstance(call, ast.Call):
        return ""
    names = [*call.args[:1], *(k.value for k in call.keywords if k.arg == "name")]
    return next((str(one.value) for one in names if isinstance(one, ast.Constant)), "")
