"""What crosses the wall: versions, types, camera paths."""

import dataclasses
import math

import pytest

from torch_backend import contract


def test_request_round_trip_keeps_types():
    params = contract.FreezeParams(t_star=12, t_star_per_frame={"3": 4.5})
    request = contract.JobRequest("freeze", "somewhere", dataclasses.asdict(params))
    back = contract.from_dict(contract.JobRequest, dataclasses.asdict(request))
    assert back.typed_params() == params


@pytest.mark.parametrize(
    ("params", "word"),
    [({"iterations": "many"}, "iterations"), ({"iterations": True}, "iterations"), ({"speed": 1}, "speed")],
)
def test_wrong_params_are_named(params, word):
    with pytest.raises(ValueError, match=word):
        contract.JobRequest("train", "x", params).typed_params()


def test_unknown_kind_is_named():
    with pytest.raises(ValueError, match="dance"):
        contract.JobRequest("dance", "x").typed_params()


def test_newer_version_is_refused_in_words():
    with pytest.raises(ValueError, match="update the add-on"):
        contract.check_version({"version": contract.CONTRACT_VERSION + 1}, "camera path")


def test_camera_path_round_trip(tmp_path):
    frame = contract.CameraFrame(7, [float(i) for i in range(16)], [500.0, 501.0, 160.0, 90.0], "localised")
    path = contract.CameraPath(320, 180, [frame])
    assert contract.CameraPath.from_json(path.to_json()) == path


@pytest.mark.parametrize("bad", [[0.0] * 15, [math.nan] * 16])
def test_camera_frame_refuses_bad_matrices(bad):
    with pytest.raises(ValueError, match="camera frame 3"):
        contract.CameraFrame(3, bad, [1.0, 1.0, 0.0, 0.0])


def test_json_error_names_the_file(tmp_path):
    path = tmp_path / "broken.json"
    path.write_text("{ not json", encoding="utf-8")
    with pytest.raises(ValueError, match=r"broken\.json"):
        contract.read_json(path)
