"""What `farm export` is given: shots, clips, instants."""

import pytest

from torch_backend.contract import JobError, write_json
from torch_backend.farm.shots import gather, parse_instants, read_instants, read_requests


def test_takes_are_named_by_their_instants_where_there_are_several(shot, requests):
    roots = [str(shot("hall").root), str(shot("kitchen").root)]
    hall, kitchen = gather(roots, requests(take="hero"), [4, 12], {"kitchen": [7]}, "")
    assert hall.takes == {"4": "hero_0004", "12": "hero_0012"} and kitchen.takes == {"7": "hero"}
    assert (hall.first, hall.last, hall.frames, hall.working, hall.source) == (1, 20, 20, (640, 360), (1920, 1080))
    (one,) = gather(roots[:1], requests(), [], {}, "")
    assert one.takes == {"": "freeze"}, "suggested: known when it is opened"


def test_shots_of_one_name_have_steps_of_two(shot, requests, tmp_path):
    first = shot("hall").root
    second = first.with_name("other.splannequin")
    write_json(second / "shot.json", {"version": 1, "name": "hall"})
    (second / "frames").mkdir()
    (second / "frames" / "frames.json").write_bytes((first / "frames" / "frames.json").read_bytes())
    assert [one.name for one in gather([str(first), str(second)], requests(), [], {}, "")] == ["hall", "hall 2"]


def test_what_is_done_is_told_from_what_is_not(shot, requests):
    made = shot("hall")
    (one,) = gather([str(made.root)], requests(), [], {}, "")
    assert (one.solved, one.trained) == (False, False)
    write_json(made.cameras, {})
    for name in ("summary.json", "checkpoint.safetensors"):
        (made.run("main")).mkdir(parents=True, exist_ok=True)
        (made.run("main") / name).write_text("{}")
    (one,) = gather([str(made.root)], requests(), [], {}, "")
    assert (one.solved, one.trained) == (True, True)
    (one,) = gather([str(made.root)], requests(), [], {}, "", trained_counts=False)
    assert not one.trained, "where other settings are asked for"
    (one,) = gather([str(made.root)], requests(run="other"), [], {}, "")
    assert not one.trained


def test_a_camera_path_goes_into_the_shot(shot, requests, tmp_path):
    made = shot("hall")
    write_json(
        tmp_path / "move.json", {"version": 1, "width": 64, "height": 48, "frames": [{"frame": 7}, {"frame": 9}]}
    )
    (one,) = gather([str(made.root)], requests(camera_path=str(tmp_path / "move.json")), [], {}, "")
    assert one.requests["freeze"]["camera_path"] == "paths/freeze.json"
    assert (made.root / "paths" / "freeze.json").is_file() and (one.first, one.last) == (7, 9)


@pytest.mark.parametrize(
    ("instants", "table", "said"),
    [([21], {}, "t\\* is frame 21: hall has frames 1 to 20"), ([], {"hal": [3]}, "names hal, which is none")],
)
def test_instants_that_cannot_be_are_said_before_any_work(shot, requests, instants, table, said):
    with pytest.raises(JobError, match=said):
        gather([str(shot("hall").root)], requests(), instants, table, "")


def test_a_folder_without_an_import_is_refused(tmp_path, requests):
    write_json(tmp_path / "a.splannequin" / "shot.json", {"version": 1, "name": "a"})
    with pytest.raises(JobError, match="holds no imported clip"):
        gather([str(tmp_path / "a.splannequin")], requests(), [], {}, "")


def test_a_list_of_instants(tmp_path):
    file = tmp_path / "list.txt"
    file.write_text("# night shoot\nkitchen 34, 60\nhall 2.splannequin: -3 5  # two\n\nkitchen 70\n")
    assert read_instants(str(file)) == {"kitchen": [34, 60, 70], "hall 2": [-3, 5]}
    file.write_text("kitchen 34\n", encoding="utf-8-sig")
    assert read_instants(str(file)) == {"kitchen": [34]}
    file.write_text("kitchen\n")
    with pytest.raises(JobError, match=r"Line 1 .* is not the name of a shot and its instants"):
        read_instants(str(file))
    assert parse_instants(" 34,60 7") == [34, 60, 7] and parse_instants("") == []
    with pytest.raises(JobError, match="'x' are no instants"):
        parse_instants("x")


def test_parameters_of_a_file_stand_over_the_options(tmp_path, requests):
    file = tmp_path / "request.json"
    write_json(file, {"freeze": {"width": 320, "t_star_per_frame": {"3": 4.0}}, "train": {"preset": "final"}})
    asked = read_requests(str(file), requests(take="hero"))
    assert (asked["freeze"].width, asked["freeze"].take, asked["train"].preset) == (320, "hero", "final")
    for wrong, said in (({"bake": {}}, "'bake' is none of"), ({"freeze": {"wide": 3}}, "wide")):
        write_json(file, wrong)
        with pytest.raises(JobError, match=said):
            read_requests(str(file), requests())
