"""Main function of COLMAP's child process, which `start_worker.py` starts.

COLMAP runs in a separate process for three reasons: pycolmap and OpenImageIO cannot share a process (see
footage/images.py), COLMAP aborts its process on a failed check, and a process can be stopped at any moment. Only the
worker imports the modules that load pycolmap: `request.py`, `matching.py`, `pairs.py`, `mapping.py`, `placing.py`,
`answers.py` and `colmap_types.py`.

The parent holds standard input open; when it closes, the worker exits. Standard output carries JSON lines: {"stage"}
when a stage begins, with {"done", "total"} if COLMAP reports progress; {"result": {...}} or {"failure": "reason"} at
the end.
In the request's folder it writes model/ (binary COLMAP model), points.npz, poses.json (world-to-camera, 3x4) and, for
each lens, undistort_N.npz (the lens, the pinhole camera of the undistorted frames, and the map of their pixels).

A request with "known" cameras ({"lenses": [{"model", "width", "height", "params"}], "images": {name: {"lens",
"pose"}}, "triangulate"}) is not solved: the lenses are undistorted and, if requested, points are triangulated with the
poses fixed. For a request with pairs to "match", the worker only matches them in its copy of the database (`pairs.py`).
"""

from __future__ import annotations

import os
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from ..contract import detach_standard_input
from ..lens.lens_verdict import angle_deg, bends_of, impossible
from . import colmap_types as colmap
from .answers import focal_changes, write_answers, write_points, write_undistortion
from .mapping import (
    agreement,
    build,
    first_camera,
    is_as_good,
    left_bend,
    lens_doubt,
    lens_of,
    registered_images,
    triangulate,
    triangulation_angle,
)
from .matching import STILL_SHARE, common, extract, match, only_rotates
from .pairs import match_lines
from .placing import localise
from .request import SEED, Request, say


def main(path: str) -> int:
    """Runs the request and returns 0. A failed solve is reported with `say`; any other error raises."""
    threading.Thread(target=_die_with_parent, args=(detach_standard_input(),), daemon=True).start()
    request = Request(Path(path))
    pycolmap.set_random_seed(SEED)
    if request.match:
        match_lines(request, request.match)
        return 0
    if request.known is not None:
        return take_over(request, request.known)
    if not request.reuse:
        extract(request, request.solved, None)
    match(request)
    shared = common(request)
    if not shared.pairs:
        say(failure="bare", **vars(shared))
        return 0
    if shared.flow_px < STILL_SHARE * request.size[0]:
        say(failure="still", **vars(shared))
        return 0
    models = build(request)
    if not models:
        say(failure="turning" if only_rotates(request) else "no_pair", **vars(shared))
        return 0
    doubt = lens_doubt(request, models[0])
    first, is_fixed = first_camera(models[0]), False
    if doubt:
        retried = build(request, hold_lens=True)
        is_fixed = bool(retried) and is_as_good(retried[0], models[0])
        models = retried if is_fixed else models
    poses = localise(request, models[0])
    write_answers(request, models[0], poses)
    lens = {"doubt": doubt, "held": is_fixed, **_found(request, first, models[0])}
    result = _result(models, len(poses))
    say(result={**result, "flow_px": shared.flow_px, "turning": only_rotates(request), "lens": lens})
    return 0


def _result(models: list[pycolmap.Reconstruction], placed: int) -> dict[str, Any]:
    """Figures of the solve for the parent. The first model is used; `placed` frames have a pose."""
    model, camera = models[0], first_camera(models[0])
    return {
        "registered": model.num_reg_images(),
        "parts": [sorted(image.name for image in registered_images(m)) for m in models],
        "reprojection_error_px": model.compute_mean_reprojection_error(),
        "points": model.num_points3D(),
        "triangulation_angle_deg": triangulation_angle(model),
        "camera_model": camera.model_name,
        "focal_px": camera.mean_focal_length(),
        "distortion": [float(camera.params[i]) for i in camera.extra_params_idxs()],
        "focal_changes": focal_changes(model),
        "localised": placed - model.num_reg_images(),
    }


def _found(request: Request, first: pycolmap.Camera, model: pycolmap.Reconstruction) -> dict[str, Any]:
    """Figures of the lens that was found at first, and of the lens that is used."""
    camera = first_camera(model)
    return {
        "found_px": first.mean_focal_length(),
        "found_deg": angle_deg(*lens_of(first)),
        "found_bend": bends_of(first.model_name, [float(value) for value in first.params])[0],
        "view_deg": angle_deg(*lens_of(camera)),
        "impossible": impossible(*lens_of(camera)),
        "given_px": request.focal,
        "start_px": request.start_focal,
        "width": camera.width,
        "height": camera.height,
        **({"left_bend": left_bend(model)} if request.hold_bend else {}),
    }


def take_over(request: Request, known: dict[str, Any]) -> int:
    """Undistorts the lenses of known cameras and, if requested, triangulates points; returns 0."""
    lenses = [
        pycolmap.Camera(model=n["model"], width=n["width"], height=n["height"], params=n["params"])
        for n in known["lenses"]
    ]
    for number, lens in enumerate(lenses):
        say(stage="lens", done=number, total=len(lenses))
        write_undistortion(request, lens, number)
    if not known["triangulate"]:
        say(result={})
        return 0
    poses = {name: (image["lens"], np.array(image["pose"], np.float64)) for name, image in known["images"].items()}
    model = triangulate(request, lenses, poses)
    if not model.num_points3D():
        say(result={"points": 0})
        return 0
    write_points(request, model)
    folder = request.scratch / "model"
    folder.mkdir()
    colmap.write_binary(model, folder)
    say(
        result={
            "points": model.num_points3D(),
            "reprojection_error_px": model.compute_mean_reprojection_error(),
            "triangulation_angle_deg": triangulation_angle(model),
            "agreement": agreement(request, model),
        }
    )
    return 0


def _die_with_parent(pipe: int) -> None:
    # Unbuffered, because at exit the interpreter cannot close a buffer that a thread is still reading.
    while os.read(pipe, 64):
        pass
    os._exit(1)
