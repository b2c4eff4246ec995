"""The job template: valid, without local paths outside of the mapped ones, one chain of steps per shot."""

import json
import subprocess
import sys

import pytest

from torch_backend import cli
from torch_backend.contract import JobError, write_json
from torch_backend.farm import export as exporting
from torch_backend.farm.request import read_request
from torch_backend.farm.shots import gather
from torch_backend.farm.template import Needs, job_template
from torch_backend.farm.work import steps_of


@pytest.fixture
def shots(shot):
    """Two shots; the name of one contains the syntax of a template reference."""
    hall, kitchen = shot("hall").root, shot("kitchen", last=23)
    write_json(kitchen.info_path, {"version": 1, "name": "kit {{chen}}"})
    return [str(hall), str(kitchen.root)]


@pytest.fixture
def job(tmp_path, shots, capsys):
    """job(*words): (template, parameters, folder) of `farm export` of both shots with these options."""

    def make(*words):
        folder = tmp_path / "job"
        assert cli.main(["farm", "export", *shots, "--output", str(folder), *words]) == 0, capsys.readouterr().err
        return *(json.loads((folder / name).read_text()) for name in ("template.json", "parameters.json")), folder

    return make


def named(template, name):
    return next(step for step in template["steps"] if step["name"] == name)


def space(step):
    return {one["name"]: one for one in step["parameterSpace"]["taskParameterDefinitions"]}


def test_the_kept_library_finds_nothing_wrong(job):
    pytest.importorskip("openjd.cli")
    *_, folder = job("--t-star", "4,12", "--bake", "--ignore-mask", "mask.png", "--device", "cuda")
    template = folder / "template.json"
    for words in (["check", template], ["summary", template, "-p", f"file://{folder / 'parameters.json'}"]):
        done = subprocess.run(
            [sys.executable, "-P", "-m", "openjd", *map(str, words)], capture_output=True, text=True, cwd=folder
        )
        assert done.returncode == 0, done.stdout + done.stderr
    assert "'hall: freeze' (4 total Tasks)" in done.stdout


def test_what_an_import_finds_is_no_file_of_the_farm(job):
    template, *_ = job("--ignore-mask", "found")
    assert not any("Mask" in one["name"] for one in template.get("parameterDefinitions", []))
    assert '"ignore_mask": "found"' in str(named(template, "hall: solve"))


def test_each_shot_has_a_separate_task_chain(job):
    template, *_ = job("--t-star", "4,12", "--bake")
    kinds = ["solve", "train", "open", "freeze", "finish", "bake", "deliver"]
    for shot in ("hall", "kit __chen__"):
        for before, kind in zip([None, *kinds], kinds, strict=False):
            waits = named(template, f"{shot}: {kind}").get("dependencies", [])
            assert waits == ([{"dependsOn": f"{shot}: {before}"}] if before else [])
    assert len(template["steps"]) == 14


def test_tasks_are_instants_and_parts(job):
    template, *_ = job("--t-star", "4,12", "--frames", "8")
    freeze = space(named(template, "kit __chen__: freeze"))
    assert freeze["TStar"]["range"] == [4, 12] and freeze["First"]["range"] == [1, 9, 17]
    assert set(space(named(template, "hall: finish"))) == {"Shot", "TStar"}
    assert set(space(named(template, "hall: train"))) == {"Shot"}
    template, *_ = job()
    assert set(space(named(template, "hall: open"))) == {"Shot"}, "the instant is suggested"


def strings(node, at=()):
    if isinstance(node, str):
        yield at, node
    elif isinstance(node, dict):
        for key, value in node.items():
            yield from strings(value, (*at, key))
    elif isinstance(node, list):
        for value in node:
            yield from strings(value, at)


def test_submitter_paths_appear_only_where_mapped(job, tmp_path):
    (tmp_path / "mask.png").touch()
    template, values, _ = job("--t-star", "4", "--bake", "--people-mask", str(tmp_path / "mask.png"))
    types = {one["name"]: one["type"] for one in template["parameterDefinitions"]}
    ours = (str(tmp_path), str(exporting.SOFTWARE), sys.executable)
    mapped = 0
    for step in template["steps"]:
        for one in step["parameterSpace"]["taskParameterDefinitions"]:
            if one["type"] == "PATH":
                mapped += len(one.pop("range"))
    assert mapped == 14
    assert not [(at, text) for at, text in strings(template) if any(path in text for path in ours)]
    assert {name for name, value in values.items() if any(path in value for path in ours)} == {
        "Splannequin", "OutputFolder", "SolvePeopleMask",
    }  # fmt: skip
    assert all(types[name] == "PATH" for name in ("Splannequin", "OutputFolder", "SolvePeopleMask"))
    words = named(template, "hall: solve")["script"]["actions"]["onRun"]["args"]
    assert "solve.people_mask={{Param.SolvePeopleMask}}" in words
    assert "--paths" not in named(template, "hall: train")["script"]["actions"]["onRun"]["args"]


def test_task_parameters_round_trip_through_their_file(job, tmp_path):
    (tmp_path / "request.json").write_text('{"freeze": {"t_star_per_frame": {"3": 4.0}, "camera_path": ""}}')
    template, *_ = job("--freeze-width", "320", "--request", str(tmp_path / "request.json"))
    file = named(template, "kit __chen__: freeze")["script"]["embeddedFiles"][0]
    assert "{{" not in file["data"]
    (tmp_path / "out.json").write_text(file["data"])
    request = read_request(tmp_path / "out.json")
    assert request["freeze"]["width"] == 320 and request["freeze"]["t_star_per_frame"] == {"3": 4.0}
    assert (request["takes"], request["first"], request["last"]) == ({"": "freeze"}, 1, 23)
    write_json(tmp_path / "out.json", {**request, "version": 2})
    with pytest.raises(JobError, match="is not a request"):
        read_request(tmp_path / "out.json")


def test_gpu_hosts_are_requested_where_needed(job):
    for device, cards in (("cuda", ["train", "open", "freeze"]), ("auto", [])):
        template, *_ = job("--device", device)
        found = [
            step["name"]
            for step in template["steps"]
            if {"name": "amount.worker.gpu", "min": 1} in step["hostRequirements"]["amounts"]
        ]
        assert found == [f"{shot}: {kind}" for kind in cards for shot in ("hall", "kit __chen__")]


def test_many_shots_are_split_into_several_jobs(shots, tmp_path):
    assert cli.main(["farm", "export", *shots, "--output", str(tmp_path), "--shots-per-job", "1"]) == 0
    names = [json.loads((tmp_path / f"job-00{n}" / "template.json").read_text())["name"] for n in (1, 2)]
    assert names == ["Splannequin: hall", "Splannequin: kit __chen__"]


ODD = [
    "hall",
    "hall",
    "a}}b",
    "{{Param.Home}}",
    "../../evil",
    "x" * 300,
    "\udcff.mp4",
    "t\tab\x7f\x85",
    "h\u00e4ll \U0001f3ac",
]
"""Odd names that a shot.json may hold."""


def test_whatever_shots_are_called_the_engine_takes_the_job(tmp_path, imported, capsys):
    model = pytest.importorskip("openjd.model")
    roots = []
    for n, name in enumerate(ODD):
        one = imported(tmp_path / "shots", f"shot{n}")
        write_json(one.info_path, {"version": 1, "name": name})
        roots.append(str(one.root))
    words = ["--bake", "--t-star", "4,12"]
    assert cli.main(["farm", "export", *roots, "--output", str(tmp_path / "job"), *words]) == 0, capsys.readouterr().err
    template = json.loads((tmp_path / "job" / "template.json").read_text())
    values = json.loads((tmp_path / "job" / "parameters.json").read_text())
    read = model.decode_job_template(template=template)
    preprocessed = model.preprocess_job_parameters(
        job_template=read, job_parameter_values=values, job_template_dir=tmp_path / "job",
        current_working_dir=tmp_path, allow_job_template_dir_walk_up=True,
    )  # fmt: skip
    job = model.create_job(job_template=read, job_parameter_values=preprocessed)
    assert len({step.name for step in job.steps}) == len(job.steps) == len(ODD) * 7


def test_task_arguments_survive_special_characters(shot, requests):
    model = pytest.importorskip("openjd.model")
    odd = "a}}}b{{{c}}{{d\x7f\udcff\n\\u007d"
    expected = requests(t_star_per_frame={odd: 1.0})
    (one,) = gather([str(shot("hall").root)], expected, [], {}, "")
    steps = steps_of(one, 10, False)
    template = job_template("odd", steps, {step.kind: Needs(512, False) for step in steps}, False)
    model.decode_job_template(template=template)
    data = named(template, "hall: freeze")["script"]["embeddedFiles"][0]["data"]
    assert json.loads(data)["freeze"]["t_star_per_frame"] == {odd: 1.0}


@pytest.mark.parametrize("name", ["a}}b", "{{Param.Home}}", "t\tab", "no utf\udcff", "deep" * 60 + "/" + "er" * 120])
@pytest.mark.parametrize("what", ["shot", "output", "mask"])
def test_a_path_that_the_engine_refuses_is_one_sentence_at_export(imported, tmp_path, capsys, name, what):
    """Output folders and masks are parameter values, where braces have no meaning."""
    model = pytest.importorskip("openjd.model")
    name = name if len(name) < 100 else "/".join([name] * 3)
    folder, words = tmp_path / name, []
    try:
        folder.mkdir(parents=True)
    except OSError:
        pytest.skip("no such name on this disk")
    root = imported(folder if what == "shot" else tmp_path / "plain", "hall").root
    if what == "mask":
        (folder / "mask.png").touch()
        words = ["--people-mask", str(folder / "mask.png")]
    output = folder if what == "output" else tmp_path / "job"
    code = cli.main(["farm", "export", str(root), "--output", str(output), "--bake", *words])
    said = capsys.readouterr()
    if what != "shot" and ("{{" in name or "}}" in name):
        assert code == 0
        values = json.loads((output / "parameters.json").read_text())
        template = model.decode_job_template(template=json.loads((output / "template.json").read_text()))
        model.preprocess_job_parameters(
            job_template=template, job_parameter_values=values, job_template_dir=output, current_working_dir=output,
            allow_job_template_dir_walk_up=True,
        )  # fmt: skip
    else:
        assert code == 2 and "Traceback" not in said.err and not (output / "template.json").exists()
        assert said.err.count("\n") <= 2, said.err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--frames", "0"), "--frames is 0"),
        (("--t-star", "99"), "t* is frame 99: hall has frames 1 to 20"),
        (("--rates", "no.json"), "no.json is not a file of rates"),
    ],
)
def test_what_cannot_be_is_one_sentence(shots, tmp_path, words, said, capsys):
    assert cli.main(["farm", "export", *shots, "--output", str(tmp_path / "job"), *words]) == 2
    assert said in capsys.readouterr().err
