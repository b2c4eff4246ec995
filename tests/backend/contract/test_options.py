"""The table of options: every option is effective, and both command lines and the panel use its texts."""

import argparse
import ast
import dataclasses
from pathlib import Path

import pytest

from torch_backend import cli, contract
from torch_backend.contract import option_table

ROOT = Path(__file__).resolve().parents[3]
NEEDED = {
    "import": ("s.splannequin", "a.mp4"),
    "freeze": ("a.mp4",),
    "farm": ("export", "s.splannequin", "--output", "job"),
}
"""Required words of each command."""


def cases():
    """(command, words, affected fields of job kinds) of every option of every command."""
    for command, kinds in contract.COMMANDS.items():
        found: dict[tuple[str, ...], list[str]] = {}
        for kind, cls in kinds.items():
            for one, option in contract.options_for(command, cls):
                if option.flag.startswith("--"):
                    found.setdefault(words_for(one, option), []).append(f"{kind}.{one.name}")
        for words, fields in found.items():
            yield pytest.param(command, words, fields, id=f"{command} {words[0]}")


def words_for(one, option) -> tuple[str, ...]:
    """An option with a value that differs from its default."""
    if option.switch:
        return (option.flag,)
    if option.choices:
        return option.flag, next(choice for choice in option.choices if choice != one.default)
    if one.name == "position":
        return option.flag, "1,2,3"
    return option.flag, "48" if "str" not in str(one.type) else "word"


def fields_of(args: argparse.Namespace) -> dict[str, object]:
    requested = contract.requested_params(args).items()
    return {f"{kind}.{name}": value for kind, params in requested for name, value in dataclasses.asdict(params).items()}


@pytest.mark.parametrize(("command", "words", "fields"), list(cases()))
def test_every_option_changes_what_it_is_for_and_nothing_else(command, words, fields):
    bare = [command, *NEEDED.get(command, ("s.splannequin",))]
    before = fields_of(cli.parser().parse_args(bare))
    after = fields_of(cli.parser().parse_args([*bare, *words]))
    assert {name for name in before if before[name] != after[name]} == set(fields)
    for kind, params in contract.requested_params(cli.parser().parse_args([*bare, *words])).items():
        assert isinstance(params, contract.PARAMS[kind])


def test_without_options_every_field_has_its_default():
    for command in contract.COMMANDS:
        args = cli.parser().parse_args([command, *NEEDED.get(command, ("s.splannequin",))])
        for params in contract.requested_params(args).values():
            plain = dataclasses.asdict(type(params)())
            changed = {name for name, value in plain.items() if value != getattr(params, name)} - {"source"}
            assert changed == ({"only_missing"} if isinstance(params, contract.FreezeParams) else set())


def test_every_option_says_what_it_does():
    for cls in contract.PARAMS.values():
        for one, option in option_table.options_of(cls):
            assert not option.flag or (option.help and option.help[-1] not in ".:"), one.name
            assert bool(option.label) == bool(option.tip), one.name
            assert not option.items or set(option.items) == set(option.choices), one.name


def read_of(files, names: tuple[str, ...]) -> set[str]:
    """Attributes that `files` read from variables and attributes of these names."""
    found = set()
    for file in files:
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Attribute) and ast.unparse(node.value).rpartition(".")[2] in names:
                found.add(node.attr)
    return found


@pytest.mark.parametrize(
    ("kind", "station"),
    [
        ("import", "footage"),
        ("solve", "sfm"),
        ("train", "train"),
        ("freeze", "freeze"),
        ("mattes", "freeze"),
        ("surface", "freeze"),
        ("light", "freeze"),
    ],
)
def test_no_parameter_of_a_step_is_passed_over_by_its_station(kind, station):
    backend = ROOT / "torch_backend"
    read = read_of([*(backend / station).rglob("*.py"), backend / "job.py"], ("params", "asked", "config"))
    assert {one.name for one in dataclasses.fields(contract.PARAMS[kind])} - read == set()


@pytest.mark.parametrize(
    ("side", "files"),
    [
        (contract.BACKEND, ("torch_backend/cli.py", "torch_backend/farm_task.py", "torch_backend/farm/export.py")),
        (contract.BLENDER, ("splannequin_addon/command_line/headless.py",)),
    ],
)
def test_no_word_of_a_verb_is_passed_over_by_its_side(side, files):
    read = read_of([ROOT / file for file in files], ("args", "words"))
    for name, verb in contract.VERBS.items():
        if side in verb.sides and (side, name) not in ((contract.BLENDER, "farm"), (contract.BLENDER, "export")):
            # Options that are passed on are checked below.
            dests = {option.dest for _, option in contract.options_for(name, verb.words, side)}
            assert dests - read == set(), name


def test_words_that_are_handed_on_are_read_as_they_were_said(tmp_path):
    words = contract.FarmWords(
        action="measure", shots=["/shots/a b", "s3://clips/c.mov"], output=str(tmp_path), t_star="-3,60", frames=4,
        t_star_list="/list", bake=True, shots_folder="/shots", shots_per_job=3, request="/r.json", rates="/rates",
        session_tasks=2,
    )  # fmt: skip
    for whole in (words, contract.FarmWords(shots=["/one"], output="/out", t_star=None)):
        said = contract.arguments_of(whole)
        assert contract.words_of(cli.parser().parse_args(["farm", *said])) == whole
    assert said == ["export", "/one", "--output=/out"], "what is as by default is not said"
    words_of_export = contract.ExportWords(
        shot="/a b.splannequin", format="usd", text=True, take="late", placement="/p.json", output="/out"
    )
    read = contract.words_of(cli.parser().parse_args(["export", *contract.arguments_of(words_of_export)]))
    assert read == words_of_export
    unchanged = [one.name for one in dataclasses.fields(read) if getattr(read, one.name) == one.default]
    assert unchanged == [], "each of them was asked about"
    changed = {one.name for one in dataclasses.fields(words) if getattr(words, one.name) != one.default}
    assert changed == {one.name for one in dataclasses.fields(words)}, "each of them was asked about"


def test_the_scan_sees_what_is_read(tmp_path):
    (tmp_path / "a.py").write_text("def f(params, self):\n    return params.one + self.params.two, other.three\n")
    assert read_of([tmp_path / "a.py"], ("params",)) == {"one", "two"}


def ask(*words):
    return contract.requested_params(cli.parser().parse_args([str(w) for w in words]))


def test_freeze_of_a_shot_requests_one_step_and_of_a_clip_all(tmp_path):
    (tmp_path / "renamed").mkdir()
    (tmp_path / "renamed" / "shot.json").touch()
    (tmp_path / "pictures").mkdir()
    for shot in ("gone.splannequin", tmp_path / "renamed"):
        assert ask("freeze", shot, "--t-star", 3, "--run", "other") == {
            "freeze": contract.FreezeParams(run="other", t_star=3, only_missing=True)
        }
    ranged = ask("freeze", "gone.splannequin", "--first", 3, "--last=9", "--step", 2)
    assert ranged == {"freeze": contract.FreezeParams(first=3, last=9, step=2, only_missing=True)}
    for clip in ("a.mp4", tmp_path / "pictures", "rtsp://host/a.splannequin"):
        assert tuple(ask("freeze", clip)) == ("import", "solve", "train", "freeze")


@pytest.mark.parametrize(
    ("words", "named", "instead"),
    [
        (("--fps", "24"), "--fps is for a clip", "Leave it out, or pass it to `import`."),
        (
            ("--preset=preview", "--iter", "5", "--camera-model", "OPENCV"),
            "--preset, --iterations and --camera-model are for a clip",
            "Leave them out, or pass them to `solve` and `train`.",
        ),
        (("--output", "output"), "--output is for a clip", "Leave it out."),
        (("--restart",), "--restart is for a clip", "Leave it out, or pass it to `train`."),
    ],
)
def test_what_a_clip_wants_is_refused_of_a_shot_in_one_sentence(words, named, instead, capsys):
    """Also if the value is the default, or the option is abbreviated."""
    assert cli.main(["freeze", "s.splannequin", *words]) == contract.ExitCode.USAGE
    said = capsys.readouterr().err
    assert named in said and "s.splannequin is a shot folder" in said and said.count("\n") == 1
    assert said.rstrip().endswith(instead)


@pytest.mark.parametrize(
    ("words", "note"),
    [
        (("take", "s.splannequin"), "`take SHOT` is now called `freeze SHOT`"),
        (("train", "s.splannequin", "--host", "mlp", "--method", "static"), "--host is ignored"),
        (("train", "s.splannequin", "--detector", "weight"), "only works with --supervision paper"),
        (
            ("train", "s.splannequin", "--extend", "9", "--preset", "final", "--run", "a"),
            "--preset: ignored with --extend",
        ),
        (("export", "s.splannequin", "--output", "o", "--format", "nerfstudio", "--text"), "--text is ignored"),
    ],
)
def test_ignored_and_outdated_options_print_a_note(words, note, capsys):
    assert cli.main(list(words)) == contract.ExitCode.USAGE  # this shot does not exist
    first, _, rest = capsys.readouterr().err.partition("\n")
    assert first.startswith("note: ") and note in first and rest.count("\n") == 1


@pytest.mark.parametrize(
    "words",
    [
        ("freeze", "s.splannequin", "--t-star", "3"),
        ("train", "s", "--host", "mlp"),
        ("train", "s", "--supervision", "paper", "--detector", "weight"),
        ("train", "s", "--extend", "9", "--run", "a", "--device", "cpu"),
        ("export", "s", "--output", "o", "--text"),
    ],
)
def test_what_is_heeded_has_no_note(words):
    assert contract.notes(cli.parser().parse_args(list(words))) == []


def test_json_flag_works_before_and_after_the_verb(tmp_path, capsys):
    assert contract.as_json(cli.parser().parse_args(["--json", "status", "s"]))
    assert contract.as_json(cli.parser().parse_args(["status", "s", "--json"]))
    assert not contract.as_json(cli.parser().parse_args(["status", "s"]))


def test_limits_are_said_as_they_are():
    with pytest.raises(ValueError, match=r"is 5.0: it should be 0.25 to 4"):
        contract.check_params(contract.ImportParams(source="clip.mp4", pixel_aspect=5.0))
    with pytest.raises(ValueError, match=r"t\* is set for frame '--5', which is not a frame number"):
        contract.check_params(contract.FreezeParams(t_star_per_frame={"--5": 3.0}))


def test_masks_are_files_or_words(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def masks_of(*words: str) -> tuple[str, str]:
        args = cli.parser().parse_args(["solve", "s.splannequin", *words])
        solve = contract.requested_params(args)["solve"]
        return solve.ignore_mask, solve.people_mask

    assert masks_of() == ("found", "")
    assert masks_of("--ignore-mask", "none", "--people-mask", "none") == ("", "")
    assert masks_of("--ignore-mask", "alpha", "--people-mask", "alpha") == ("alpha", "alpha")
    assert masks_of("--ignore-mask", "./found", "--people-mask", "found") == (str(tmp_path / "found"),) * 2
