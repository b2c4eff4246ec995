"""Export for Farm as button and command, with the real backend; and a bake in parts by several processes at once."""

import json
import sys

import bpy
import pytest


@pytest.fixture
def imported(shot, contract):
    """Shot with the record that an import writes."""
    shot_folder = contract.ShotFolder(shot)
    frames = [{"frame": n, "file": f"raw/{n:06d}.png"} for n in range(5, 8)]
    record = (
        json.loads(shot_folder.listing.read_text()) if shot_folder.listing.is_file() else {"width": 64, "height": 36}
    )
    contract.write_json(shot_folder.listing, {**record, "frames": record.get("frames") or frames})
    return shot


def kinds(template):
    return [step["name"].rpartition(": ")[2] for step in template["steps"]]


def request_of(template, kind):
    step = next(step for step in template["steps"] if step["name"].endswith(f": {kind}"))
    return json.loads(step["script"]["embeddedFiles"][0]["data"])


def test_the_button_writes_a_job_with_what_the_artist_set(scene, imported, tmp_path):
    scene.splannequin.shot_path = str(imported)
    scene.splannequin.take_name = "hero"
    scene.splannequin.choose_t_star = True
    scene.splannequin.t_star = 6
    out = tmp_path / "job"
    assert bpy.ops.splannequin.export_for_farm(directory=str(out), frames=2, bake=True) == {"FINISHED"}
    template = json.loads((out / "template.json").read_text())
    assert kinds(template)[-5:] == ["open", "freeze", "finish", "bake", "deliver"]
    request = request_of(template, "freeze")
    assert request["takes"] == {"6": "hero"} and request["freeze"]["only_missing"]
    (places,) = {str(one["parameterSpace"]["taskParameterDefinitions"][0]["range"]) for one in template["steps"]}
    assert places == str([str(imported)])


def test_export_button_is_enabled_once_something_can_be_exported(scene, shot):
    """Also in a script, where no timer reads the folder."""
    scene.splannequin.shot_path = str(shot)
    (shot / "shot.json").rename(shot / "away")
    assert not bpy.ops.splannequin.export_for_farm.poll()
    (shot / "away").rename(shot / "shot.json")
    assert bpy.ops.splannequin.export_for_farm.poll()


def test_the_button_says_what_is_wrong(scene, imported, tmp_path, monkeypatch):
    scene.splannequin.shot_path = str(imported)
    with pytest.raises(RuntimeError, match="No folder is chosen"):
        bpy.ops.splannequin.export_for_farm()
    monkeypatch.setenv("SPLANNEQUIN_BACKEND_PYTHON", str(tmp_path / "absent"))
    with pytest.raises(RuntimeError, match="does not exist"):
        bpy.ops.splannequin.export_for_farm(directory=str(tmp_path / "job"))
    assert not (tmp_path / "job").exists(), "no request is written without a backend"


def test_the_verb_passes_its_words_on(run, imported, tmp_path, stand_in):
    out = tmp_path / "job"
    stand_in('echo "$@"')
    words = ["--t-star", "5,7", "--frames", "2", "--freeze-width", "48", "--device", "cpu"]
    code, said, err = run("farm", "export", imported, "--output", out, *words)
    assert code == 0, err
    assert f"farm export {imported} " in said and f"--output={out}" in said and "--device cpu" in said
    assert "--t-star=5,7" in said and "--frames=2" in said
    assert json.loads((out / "request.json").read_text())["freeze"]["width"] == 48


def test_a_bake_in_parts_is_the_bake_at_once(run, shot, tmp_path):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    bake = ["bake", "--shot", shot, "--take", "freeze", "--output"]
    assert run(*bake, whole, "--part", "frames")[0] == 0
    assert sorted(p.name for p in whole.iterdir()) == ["composited"]
    assert run(*bake, parts, "--part", "frames", "--first", "6", "--last", "7")[0] == 0
    code, _, err = run(*bake, parts, "--part", "file")
    assert code == 7 and "lacks 1 of 3 frames, the first is 5" in err
    (parts / "composited" / ".part-killed").mkdir()
    assert run(*bake, parts, "--part", "frames", "--first", "5", "--last", "6")[0] == 0
    assert run(*bake, parts, "--part", "file")[0] == 0
    assert sorted(p.name for p in parts.iterdir()) == ["composited", "shot.blend", "summary.json"]
    frames = {p.name: p.read_bytes() for p in (parts / "composited").iterdir()}
    assert frames == {p.name: p.read_bytes() for p in (whole / "composited").iterdir()} and len(frames) == 3
    assert json.loads((parts / "summary.json").read_text())["composited_frames"] == 3
    bpy.ops.wm.read_homefile(use_empty=True)  # shot.blend is not the artist's file
    assert run(*bake, tmp_path / "alone")[0] == 0
    assert frames == {p.name: p.read_bytes() for p in (tmp_path / "alone" / "composited").iterdir()}
    assert not [name for name, data in frames.items() if b"tEXtFrame" in data], "its digits are those of the range"


def test_a_part_of_a_bake_freezes_nothing(run, shot, tmp_path):
    code, _, err = run("bake", "--shot", shot, "--take", "none", "--output", tmp_path, "--part", "frames")
    assert code == 7 and "A bake with --part does not freeze frames" in err and sys.executable not in err


def test_farm_export_requests_only_missing_steps(scene, imported, addon, contract):
    scene.splannequin.shot_path = str(imported)
    shot_folder = contract.ShotFolder(imported)
    assert set(addon("bake.farm").requests_of(scene, imported)) == {"freeze"}, "it is solved, and has this run"
    scene.splannequin.run_name = "other"
    assert set(addon("bake.farm").requests_of(scene, imported)) == {"train", "freeze"}
    for record in (shot_folder.solve_record, shot_folder.cameras):
        record.unlink(missing_ok=True)
    assert set(addon("bake.farm").requests_of(scene, imported)) == {"solve", "train", "freeze"}
