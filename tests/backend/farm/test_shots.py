"""Arguments of `farm export`: shots, clips, instants."""

import shutil
import unicodedata

import av
import numpy as np
import pytest

from torch_backend.contract import JobError, write_json
from torch_backend.farm.request import shot_name
from torch_backend.farm.shots import gather, parse_instants, read_instants, read_requests
from torch_backend.footage.images import write_png


def test_several_takes_are_named_by_their_instants(shot, requests):
    roots = [str(shot("hall").root), str(shot("kitchen").root)]
    hall, kitchen = gather(roots, requests(take="hero"), [4, 12], {"kitchen": [7]}, "")
    assert hall.takes == {"4": "hero_0004", "12": "hero_0012"} and kitchen.takes == {"7": "hero"}
    assert (hall.first, hall.last, hall.frames, hall.working, hall.source) == (1, 20, 20, (640, 360), (1920, 1080))
    (one,) = gather(roots[:1], requests(), [], {}, "")
    assert one.takes == {"": "freeze"}, "suggested: known when it is opened"


def test_shots_of_one_name_have_steps_and_outputs_of_two_in_any_order(imported, requests, tmp_path):
    roots = [str(imported(tmp_path / place, name).root) for place in "ab" for name in ("shot", "Shot", "hall")]
    found = {str(one.root): one for one in gather(roots, requests(), [], {}, "")}
    assert list(found) == roots
    for names in ([one.name for one in found.values()], [one.output for one in found.values()]):
        assert len({name.casefold() for name in names}) == 6
    assert all(name.startswith(("shot-", "Shot-", "hall-")) for name in names)
    again = gather(roots[::-1], requests(), [], {}, "")
    assert {str(one.root): one for one in again} == found
    (one,) = gather(roots[:1] * 2, requests(), [], {}, "")
    assert (one.name, one.output) == ("shot", "shot"), "one shot that is named twice"


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    """Video of three frames."""
    path = tmp_path_factory.mktemp("video") / "clip.mp4"
    with av.open(str(path), "w") as out:
        stream = out.add_stream("mpeg4", rate=24)
        stream.width = stream.height = 16
        for n in range(3):
            out.mux(stream.encode(av.VideoFrame.from_ndarray(np.full((16, 16, 3), 20 * n, np.uint8), "rgb24")))
        out.mux(stream.encode())
    return path


@pytest.fixture
def clip(tmp_path, video):
    """clip("a/plate.mp4"): path of a video; for a name with #, the pattern of a sequence."""

    def make(name):
        path = tmp_path / "clips" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if "#" in name:
            for n in range(1, 4):
                pixels = np.full((16, 16, 3), 20 * n, np.uint8)
                write_png(path.with_name(path.name.replace("####", f"{n:04d}")), pixels)
        else:
            shutil.copyfile(video, path)
        return str(path)

    return make


LONG = "the_long_and_winding_name_of_a_clip_that_somebody_gave_it"


@pytest.mark.parametrize("in_one_folder", [True, False])
@pytest.mark.parametrize(
    "names",
    [
        ("plate.v001.mp4", "plate.v002.mp4"),
        ("a/clip.mp4", "b/clip.mp4"),
        ("clip.mp4", "clip.mov"),
        (f"{LONG}_1.mp4", f"{LONG}_2.mp4"),
        ("take.####.png", "take.mp4"),
        ("a/{x.mp4", "b/_x.mp4"),
        ("c/Hall.mp4", "d/hall.mp4", "e/h\u00e4ll.mp4", "f/ha\u0308ll.mp4"),
    ],
)
def test_clips_get_distinct_shots_and_find_them_again(clip, requests, tmp_path, names, in_one_folder):
    clips = [clip(name) for name in names]
    folder = str(tmp_path / "shots") if in_one_folder else ""
    found = {one.clip: one for one in gather(clips, requests(), [], {}, folder)}
    for values in ([str(one.root) for one in found.values()], [one.name for one in found.values()],
                   [one.output for one in found.values()]):  # fmt: skip
        assert len({unicodedata.normalize("NFC", value).casefold() for value in values}) == len(names), values
    assert {one.clip: one for one in gather(clips[::-1], requests(), [], {}, folder)} == found
    for path in clips:
        (entry,) = gather([path], requests(), [], {}, folder)
        assert entry.root == found[path].root, "as it is found alone"


def test_clip_matches_only_the_shot_imported_from_it(clip, imported, requests, tmp_path):
    path, folder = clip("hall.mp4"), tmp_path / "clips"
    (one,) = gather([path], requests(), [], {}, "")
    assert one.root == folder / "hall.splannequin" and (one.name, one.output) == ("hall", "hall")
    (second_entry,) = gather([path], requests(), [], {}, str(tmp_path / "shots"))
    assert (
        second_entry.root.parent == tmp_path / "shots"
        and second_entry.name == "hall"
        and second_entry.output == shot_name(second_entry.root)
    )
    hall = imported(folder, "hall")
    for source, root in ((path, hall.root), (clip("else/hall.mp4"), None)):
        write_json(hall.info_path, {"version": 1, "name": "hall", "source": source})
        (one,) = gather([path], requests(), [], {}, "")
        assert (one.root == hall.root) == (root is not None)
    write_json(hall.info_path, {"version": 1, "name": "hall", "source": path})
    assert len(gather([str(hall.root), path], requests(), [], {}, "")) == 1


def test_an_instant_is_named_for_one_of_two_shots_of_a_name(imported, requests, tmp_path):
    roots = [str(imported(tmp_path / place, "hall").root) for place in "ab"]
    first = gather(roots, requests(), [], {}, "")[0]
    found = gather(roots, requests(), [], {first.name: [3], "hall": [4]}, "")
    assert [one.takes for one in found] == [{"3": "freeze"}, {"4": "freeze"}]


@pytest.mark.parametrize("field", ["take", "run"])
@pytest.mark.parametrize("name", ["../../evil", "x" * 65, "CON", "{{Param.Home}}", ""])
def test_names_that_every_task_would_refuse_are_refused_at_once(shot, requests, field, name):
    with pytest.raises(ValueError, match=f"{field} name"):
        gather([str(shot("hall").root)], requests(**{field: name}), [], {}, "")


def test_finished_work_is_distinguished_from_open_work(shot, requests):
    hall = shot("hall")
    (one,) = gather([str(hall.root)], requests(), [], {}, "")
    assert (one.solved, one.trained) == (False, False)
    write_json(hall.cameras, {})
    for name in ("summary.json", "checkpoint.safetensors"):
        (hall.run("main")).mkdir(parents=True, exist_ok=True)
        (hall.run("main") / name).write_text("{}")
    (one,) = gather([str(hall.root)], requests(), [], {}, "")
    assert (one.solved, one.trained) == (True, True)
    (one,) = gather([str(hall.root)], requests(), [], {}, "", trained_counts=False)
    assert not one.trained, "where other settings are asked for"
    (one,) = gather([str(hall.root)], requests(run="other"), [], {}, "")
    assert not one.trained


def test_a_camera_path_goes_into_the_shot(shot, requests, tmp_path):
    hall = shot("hall")
    write_json(
        tmp_path / "move.json", {"version": 1, "width": 64, "height": 48, "frames": [{"frame": 7}, {"frame": 9}]}
    )
    (one,) = gather([str(hall.root)], requests(camera_path=str(tmp_path / "move.json")), [], {}, "")
    assert one.requests["freeze"]["camera_path"] == "paths/freeze.json"
    assert (hall.root / "paths" / "freeze.json").is_file() and (one.first, one.last) == (7, 9)


@pytest.mark.parametrize(
    ("instants", "table", "said"),
    [([21], {}, "t\\* is frame 21: hall has frames 1 to 20"), ([], {"hal": [3]}, "names hal, which is not one")],
)
def test_instants_that_cannot_be_are_said_before_any_work(shot, requests, instants, table, said):
    with pytest.raises(JobError, match=said):
        gather([str(shot("hall").root)], requests(), instants, table, "")


def test_a_folder_without_an_import_is_refused(tmp_path, requests):
    write_json(tmp_path / "a.splannequin" / "shot.json", {"version": 1, "name": "a"})
    with pytest.raises(JobError, match="contains no imported clip"):
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
    with pytest.raises(JobError, match="'x' is not a list of instants"):
        parse_instants("x")


def test_file_parameters_override_options(tmp_path, requests):
    file = tmp_path / "request.json"
    write_json(file, {"freeze": {"width": 320, "t_star_per_frame": {"3": 4.0}}, "train": {"preset": "final"}})
    read = read_requests(str(file), requests(take="hero"))
    assert (read["freeze"].width, read["freeze"].take, read["train"].preset) == (320, "hero", "final")
    wrongs = (
        ({"bake": {}}, "'bake' is not one of"),
        ({"freeze": {"wide": 3}}, "wide"),
        ({"train": {"preset": "x"}}, "'x'"),
    )
    for wrong, said in wrongs:
        write_json(file, wrong)
        with pytest.raises(JobError, match=said):
            read_requests(str(file), requests())
