"""The table of the fifteen complaints: every row has a test, every test is there, every answer's text is there."""

import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests" / "addon"))

from complaints import ANSWERS  # noqa: E402  # pyright: ignore[reportMissingImports]


def test_every_answer_stands_where_the_script_takes_it_out():
    for answer in ANSWERS:
        path, text = answer.made(ROOT)  # says, if it cannot be, what is not there any more and what to do
        assert text != path.read_text(encoding="utf-8")


def test_every_test_of_the_table_is_there_and_every_answer_names_one_of_its_row():
    rows = {}
    for line in (ROOT / "docs" / "blender.md").read_text(encoding="utf-8").splitlines():
        if match := re.match(r"\| (\d+) \|.*\|(.*)\|$", line):
            file, rows[int(match[1])] = "", set()
            for name in re.findall(r"`([\w/]+\.py|[\w/.]*::\w+)`", match[2]):
                head, _, test = name.partition("::")
                file = head or file
                rows[int(match[1])].add(test)
                found = list((ROOT / "tests").rglob(Path(file).name))
                assert found, f"{file} of row {match[1]} is not there"
                assert not test or any(f"def {test}(" in f.read_text(encoding="utf-8") for f in found), name
    assert sorted(rows) == list(range(1, 16)) and all(rows.values())
    for answer in ANSWERS:
        assert answer.test.partition("::")[2] in rows[answer.complaint], f"{answer.complaint}: {answer.test}"
    assert {a.complaint for a in ANSWERS} == set(rows)
