"""A paused run is resumed with all parameters that it was started with."""

import dataclasses

SOURCES_OF_UNSTORED_FIELDS = {
    "run": "the folder's name",
    "device": "Preferences, or wherever it goes on",
    "resume": "asked for by going on",
    "extend": "of finished runs",
    "depth": "what the checkpoint says of its maps",
}
"""Map from the fields that no stored configuration holds to their source."""


def test_resume_requests_every_stored_training_number(addon, contract):
    config = {
        "preset": "preview", "method": "auto", "iterations": 1, "width": 2, "holdout": 3, "seed": 4,
        "densify": {"budget": 5}, "supervision": {"preset": "support"},
    }  # fmt: skip
    again = set(addon("shot.checkpoints").params_of(config))
    assert again | set(SOURCES_OF_UNSTORED_FIELDS) == {field.name for field in dataclasses.fields(contract.TrainParams)}
    assert not again & set(SOURCES_OF_UNSTORED_FIELDS)
