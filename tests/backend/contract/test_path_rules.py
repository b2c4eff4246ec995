"""Path mapping rules of a farm: paths that a shot stored on another computer are mapped to local ones."""

import json

import pytest

from torch_backend.contract import RULES_VARIABLE, mapped


def rule(source, destination, kind="POSIX"):
    return {"source_path_format": kind, "source_path": source, "destination_path": destination}


@pytest.mark.parametrize(
    ("path", "expected"),
    [
        ("/home/ann/clips/a.mp4", "/mnt/clips/a.mp4"),
        ("/home/ann/clips/deep/a.####.exr", "/mnt/deep/a.####.exr"),  # the rule with the longer source wins
        ("/home/ann/clipsy/a.mp4", "/mnt/ann/clipsy/a.mp4"),
        ("/home/bob/a.mp4", "/home/bob/a.mp4"),
        ("clips/a.mp4", "clips/a.mp4"),
        (r"S:\Shots\one\a.mov", "/mnt/shots/one/a.mov"),
        ("s:/shots/one/a.mov", "/mnt/shots/one/a.mov"),
    ],
)
def test_a_path_of_another_computer_is_found_by_the_rules(path, expected):
    rules = [
        rule("/home/ann", "/mnt/ann"),
        rule("/home/ann/clips", "/mnt/clips"),
        rule("/home/ann/clips/deep/", "/mnt/deep"),
        rule("S:\\shots", "/mnt/shots", "WINDOWS"),
    ]
    assert mapped(path, rules) == expected


def test_rules_are_read_from_the_file_that_the_engine_names(tmp_path, monkeypatch):
    file = tmp_path / "rules.json"
    monkeypatch.setenv(RULES_VARIABLE, str(file))
    assert mapped("/a/b") == "/a/b", "no file, no rules"
    file.write_text(json.dumps({"version": "pathmapping-1.0", "path_mapping_rules": [rule("/a", "/c")]}))
    assert mapped("/a/b") == "/c/b"
    file.write_text("{}")
    assert mapped("/a/b") == "/a/b", "what an engine without rules writes"
    file.write_text('{"path_mapping_rules": ["/a"]}')
    with pytest.raises(ValueError, match="contains no path mapping rules"):
        mapped("/a/b")
