"""Loaded by the backend's tests and, inside a bpy wheel, by the add-on's: standard library and pytest only."""

import importlib.util

if importlib.util.find_spec("hypothesis"):
    from hypothesis import settings

    # No test depends on how fast the machine is, and every run tries the same examples.
    settings.register_profile("splannequin", deadline=None, derandomize=True, max_examples=50)
    settings.load_profile("splannequin")
