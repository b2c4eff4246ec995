"""The bench of the model behind the picture: what it judges, and on which frames."""

import json

from benchmarks.model import OF_FROZEN, main


def test_a_trained_run_is_judged_frozen_and_developed_on_frames_that_it_has_not_seen(trained, tmp_path):
    world, _ = trained
    command = [str(world.shot.root), "--run", "main", "--results", str(tmp_path), "--t-star", "103", "--develop"]
    assert main([*command, "--develop-set", "steps=40", "gain=-99", "--held", "1"]) == 0
    result = json.loads((tmp_path / "model.json").read_text())
    figures = result["figures"]
    assert all(20.0 < figures[f"{kind}_large_{n}"] < 60.0 for kind in ("field", "developed") for n in OF_FROZEN[:2])
    assert figures["developed_large_frozen"] != figures["field_large_frozen"]
    assert result["develop_config"]["steps"] == 40
    for rows in (result["own"], result["frozen"]["developed"]["large"]):
        assert {row["frame"] for row in rows} == {109}
    assert [row["frame"] for row in result["held"]] == [109] and not list(tmp_path.glob("**/*.safetensors"))


def test_a_number_that_the_configuration_does_not_have_is_named(trained, tmp_path, capsys):
    world, _ = trained
    command = [str(world.shot.root), "--results", str(tmp_path), "--set", "gate.strat=0.4"]
    assert main(command) == 1 and "gate.strat" in capsys.readouterr().err
