"""Maps paths of another computer to this one, by the path mapping rules of a render farm.

The engine that runs a farm writes the rules to a file (Open Job Description, `pathmapping-1.0`). They map paths that
another computer stored in a shot, such as the path of its footage.
"""

from __future__ import annotations

import ntpath
import os
import posixpath
from pathlib import Path
from typing import Any, cast

from .errors import UserError
from .files import LONGEST_JSON, is_json_object, read_json

RULES_VARIABLE = "SPLANNEQUIN_PATH_RULES"
"""Environment variable that names the file of rules."""


def mapped(path: str, rules: list[dict[str, Any]] | None = None) -> str:
    """A path mapped by the matching rule with the longest source; unchanged if no rule matches.

    Args:
        path: absolute path on the computer that stored it, of any system.
        rules: each with source_path_format (POSIX or WINDOWS), source_path and destination_path; None: the rules in
            the file that `RULES_VARIABLE` names, if there is one.

    Raises:
        ValueError: the file of rules is invalid.
    """
    known = rules if rules is not None else _rules()
    for rule in sorted(known, key=lambda rule: -len(str(rule["source_path"]))):
        windows = str(rule["source_path_format"]).upper() == "WINDOWS"
        tail = _below(path, str(rule["source_path"]), windows)
        if tail is not None:
            return os.path.join(str(rule["destination_path"]), *tail)
    return path


def _below(path: str, source: str, windows: bool) -> list[str] | None:
    """Parts of a path below a folder; None if the path is not in the folder."""
    kind = ntpath if windows else posixpath
    if not (kind.isabs(path) or (windows and kind.splitdrive(path)[0])):
        return None
    parts, folder = _parts(path, windows), _parts(source, windows)
    same = [p.lower() for p in parts] if windows else parts, [p.lower() for p in folder] if windows else folder
    return parts[len(folder) :] if same[0][: len(folder)] == same[1] else None


def _parts(path: str, windows: bool) -> list[str]:
    text = path.replace("\\", "/") if windows else path
    return [part for part in text.split("/") if part not in ("", ".")]


def _rules() -> list[dict[str, Any]]:
    file = os.environ.get(RULES_VARIABLE, "")
    if not file or not Path(file).is_file():
        return []
    data = read_json(Path(file), LONGEST_JSON)
    rules: Any = data.get("path_mapping_rules") or []
    required = {"source_path_format", "source_path", "destination_path"}
    rows = cast("list[Any]", rules) if isinstance(rules, list) else [None]
    found = [rule for rule in rows if is_json_object(rule) and required <= set(rule)]
    if len(found) != len(rows):
        raise UserError(f"{file} contains no path mapping rules in the format of Open Job Description")
    return found
