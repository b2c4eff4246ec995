"""The panel shows the verdicts of runs and takes. Freeze uses the panel's rendering settings, Bake those of the
take."""

import json

import pytest

RUN = {"word": "fair", "sentences": ["It does not match the clip in frames 10 to 31, lower left."], "where": [],
       "advice": ["Choose t* in frames 34 to 73, or train only on that range."]}  # fmt: skip
TAKE = {"word": "good", "sentences": ["98 % of the picture is plate, 2 % is a guess."]}


def add(path, **more):
    path.write_text(json.dumps(json.loads(path.read_text()) | more))


def test_run_verdict_is_under_train_and_take_verdict_under_freeze(addon, with_shot, shot):
    shots = addon("shot.inventory")
    add(shot / "runs" / "main" / "summary.json", verdict=RUN)
    add(shot / "takes" / "freeze" / "take.json", verdict=TAKE, detail={"plate_share": 0.98})
    state = shots.read(shot)
    assert addon("process.steps").STEPS["train"].view(with_shot, state).state[:2] == [
        "Fair. It does not match the clip in frames 10 to 31, lower left.",
        "Choose t* in frames 34 to 73, or train only on that range.",
    ]
    assert (
        addon("process.steps").STEPS["freeze"].view(with_shot, state).state[1]
        == "Good. 98 % of the picture is plate, 2 % is a guess."
    )
    addon("bake.insertion").insert_freeze(with_shot, shot, "freeze")
    inherited = TAKE | {"word": "fair", "sentences": TAKE["sentences"] + RUN["sentences"], "advice": RUN["advice"]}
    add(shot / "takes" / "freeze" / "take.json", verdict=inherited)
    views = {name: step.view(with_shot, shots.read(shot)) for name, step in addon("process.steps").STEPS.items()}
    lines = [line.removeprefix("Fair. ") for view in views.values() for line in view.state]
    for sentence in [*inherited["sentences"], *RUN["advice"]]:
        assert lines.count(sentence) == 1, sentence


@pytest.mark.parametrize("damaged", [7, {"word": "good", "sentences": [1]}, {"word": "x", "sentences": ["a"]}])
def test_a_damaged_verdict_is_left_out(addon, with_shot, shot, damaged):
    for path in (shot / "runs" / "main" / "summary.json", shot / "takes" / "freeze" / "take.json"):
        add(path, verdict=damaged)
    state = addon("shot.inventory").read(shot)
    assert len(addon("process.steps").STEPS["train"].view(with_shot, state).state) == 2
    assert len(addon("process.steps").STEPS["freeze"].view(with_shot, state).state) == 2


def test_verdict_does_not_repeat_warnings(addon):
    new_warnings = addon("ui.step_panel").new_warnings
    warnings = [("Poor. It does not match the clip.", "Solve again."), ("Something else.", "")]
    assert new_warnings(warnings, ["Run main", "Poor. It does not match the clip."]) == ["Something else."]
    assert new_warnings(warnings, []) == ["Poor. It does not match the clip. Solve again.", "Something else."]


def test_verdicts_are_translated_to_german(addon):
    said = addon("translations").translate
    assert said("Fair. It does not match the clip in frames 10 to 31, lower left.", "de_DE") == (
        "Brauchbar. Es gibt den Clip nicht gut wieder in den Bildern 10 bis 31, unten links."
    )
    assert said("Good. 98 % of the picture is plate, 2 % is a guess.", "de_DE") == (
        "Gut. 98 % des Bildes sind Plate, 2 % sind geraten."
    )
    walker = "Something does not hold still: it travels up to 141 of 640 pixels in frames 10 to 40, lower right."
    assert said(walker, "de_DE") == (
        "Etwas hält nicht still: es legt bis zu 141 von 640 Pixeln zurück in den Bildern 10 bis 40, unten rechts."
    )
    assert said("Mostly a guess in frame 7, middle.", "de_DE") == "Meist geraten in Bild 7, Mitte."


def test_detail_setting_reaches_freeze_and_bake_keeps_the_take_value(addon, with_shot, shot):
    steps = addon("process.steps")
    assert steps.STEPS["freeze"].params(with_shot).detail == "on"
    with_shot.splannequin.detail = False
    assert steps.STEPS["freeze"].params(with_shot).detail == "off"
    with_shot.splannequin.detail = True
    assert steps.STEPS["bake"].params(with_shot).detail == "off", "its frames are of before there was detail"
    add(shot / "takes" / "freeze" / "take.json", detail={"plate_share": 0.9})
    with_shot.splannequin.detail = False
    assert steps.STEPS["bake"].params(with_shot).detail == "on"


def test_develop_setting_reaches_freeze_and_bake_keeps_the_take_value(addon, with_shot, shot):
    steps, props, take = addon("process.steps"), with_shot.splannequin, shot / "takes" / "freeze" / "take.json"
    requests = []
    for wanted in (True, False):
        props.develop = wanted
        requests.append(steps.STEPS["freeze"].params(with_shot).develop)
    assert requests == ["on", "off"]
    props.develop = True
    assert steps.STEPS["bake"].params(with_shot).develop == "off", "its frames are of before instants were developed"
    props.develop = False
    for frames in ([6], []):  # a ramp with many instants has no developed one
        add(take, developed=frames)
        assert steps.STEPS["bake"].params(with_shot).develop == "on"


def test_a_figure_stays_with_its_unit(addon):
    lines = addon("ui.sentences").lines
    assert lines("Good. 97 % of the picture is plate, 3 % is a guess.", 37) == [
        "Good. 97 % of the picture is plate,", "3 % is a guess.",
    ]  # fmt: skip
    assert lines("Good: 74 of 74 frames registered, 0.80 px.", 39)[-1] == "0.80 px."
    assert lines("frames 7 to 9, 3 seconds", 13) == ["frames 7 to", "9, 3 seconds"], "no unit, no bond"
    assert lines("", 16) == [""]
