"""Scrubbing: the backend's images of the frozen instant, composited by depth with the objects in the 3D view.

A view requests an image of its content at a size that renders immediately. Once the view rests, it requests a sharper
image, and then one with detail from the plates. The newest image is drawn until the next one arrives. No bpy data is
kept between draws, only GPU textures per region.
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any

import bpy
import gpu
import numpy as np
from bpy.app.handlers import persistent
from gpu_extras.batch import batch_for_shader  # pyright: ignore[reportUnknownVariableType]
from mathutils import Matrix

from ...torch_backend import contract
from .. import compat
from ..access import scene_in, settings_of
from ..process import backend, job_timer
from ..process.job_timer import redraw
from ..shot import scene_objects, seen_camera, selection
from . import hidden_points, live

TICK_SECONDS = 1 / 60
QUICK_PIXELS = 320 * 180
"""Maximum number of pixels of an image while the view changes."""
SHARP_PIXELS = 960 * 540
"""Maximum number of pixels once the view rests."""
_REST_SECONDS = 0.35

_session: live.Session | None = None
_handler: Any = None
_shader: Any = None
# (sentence, hint) about the end of the last session, or None.
_failure: tuple[str, str] | None = None
# View -> (seq of the frame, texture of its colour, texture of its depth).
_shown: dict[int, tuple[int, Any, Any]] = {}
# View -> time of its last change, monotonic seconds.
_moved: dict[int, float] = {}
# Views that were redrawn after they came to rest.
_rested: set[int] = set()


def session() -> live.Session | None:
    """The live session, or None if none is drawing."""
    return _session if _session is not None and _session.open else None


def failure() -> tuple[str, str] | None:
    """(sentence, hint) about the failure of the last session; None if it did not fail."""
    return _failure


def begin(scene: bpy.types.Scene) -> None:
    """Starts to draw the scene's run. Raises JobError without a run, a backend or a window."""
    global _session, _handler, _failure
    if bpy.app.background:
        raise contract.JobError("There is no view to draw in.", "Use Freeze.", contract.ExitCode.USAGE)
    shot, run = selection.shot_folder(scene), settings_of(scene).run_name
    if shot is None or not contract.RunFolder(contract.ShotFolder(shot).runs / run).checkpoint.is_file():
        raise contract.JobError(f"There is no trained run {run!r}.", "Train first.", contract.ExitCode.USAGE)
    end()
    _failure = None
    _session = live.open_session(shot, run, backend.python(), backend.package_root())
    hidden_points.begin(scene, shot)  # the points would cover the image
    _handler = bpy.types.SpaceView3D.draw_handler_add(_draw, (), "WINDOW", "POST_VIEW")
    job_timer.pulse(_tick)


def end() -> None:
    """Stops drawing. The backend's process ends and frees its memory."""
    global _session, _handler
    if _session is not None:
        _session.close()
        hidden_points.end()
        _session = None
    if _handler is not None:
        bpy.types.SpaceView3D.draw_handler_remove(_handler, "WINDOW")
        _handler = None
    _shown.clear()
    _moved.clear()
    _rested.clear()
    job_timer.drop(_tick)
    redraw(("WINDOW", "UI"))


def instant(scene: bpy.types.Scene) -> float | None:
    """Frame number of the drawn instant: the artist's t*, else the best suggestion; None before there is one."""
    props = settings_of(scene)
    if props.choose_t_star:
        return float(props.t_star)
    suggested = _session.facts.get("suggestions") if _session is not None else None
    return float(suggested[0]["frame"]) if suggested else None


def _suggest(scene: bpy.types.Scene) -> None:
    """Sets t* to the drawn instant if the artist has not chosen one, so that the panel and the view agree."""
    at, props = instant(scene), settings_of(scene)
    if at is not None and not props.choose_t_star and props.t_star != round(at):
        props.t_star = round(at)


def suggestions() -> list[dict[str, Any]]:
    """Instants worth freezing, best first, with frame, and seen and sharpness in 0..1; empty until the backend sends
    them."""
    return list(_session.facts.get("suggestions", [])) if _session is not None else []


def note() -> str:
    """The backend's warning from the start of the session, or empty."""
    return str(_session.facts.get("note", "")) if _session is not None else ""


def reason(scene: bpy.types.Scene) -> str:
    """Sentence about the drawn instant: why it is a good one, or which ones are suggested."""
    if _session is None or not _session.facts:
        return "The backend is loading the run."
    at = instant(scene)
    shown = _session.instants()
    for rank, one in enumerate(suggestions()):
        if one["frame"] == at:
            share, sharp = round(100 * one["seen"]), round(100 * one["sharpness"])
            if sharp == 100:
                return f"Suggestion {rank + 1}: frame {one['frame']} shows {share} % of what moves and is the sharpest."
            return (
                f"Suggestion {rank + 1}: frame {one['frame']} shows {share} % of what moves and is sharper than "
                f"{sharp} % of the frames."
            )
    suggested = f"Suggested: {', '.join(str(one['frame']) for one in suggestions())}."
    return f"Shown: frame {shown.pop()}. " + suggested if len(shown) == 1 and at not in shown else suggested


_last: tuple[int, tuple[Any, ...]] = (-1, ())
_last_reasons: tuple[str, ...] = ()


def _tick() -> float | None:
    """Redraws when a frame has arrived, when t* has changed, or when a view has come to rest. Ends with the session."""
    global _failure, _last, _last_reasons
    if _session is None:
        return None
    if _session.failure is not None:
        _failure = _session.failure
        end()
        return None
    scenes = selection.scenes_of(_session.shot)
    if not any(settings_of(s).run_name == _session.run for s in scenes):
        end()  # another file, shot or run is active
        return None
    for scene in scenes:
        _suggest(scene)
    state = _session.drawn, (bool(_session.facts), *map(_drawn_state, scenes))
    now = time.monotonic()
    # Depends on time, not on the number of ticks: without a graphics card one redraw may last longer than many ticks.
    resting = {v for v, moved in _moved.items() if now - moved > _REST_SECONDS} - _rested
    _rested.update(resting)
    if resting:
        _forget_closed_views(_session)
    if state != _last or resting:
        _last = state
        redraw(("WINDOW",))
    reasons = tuple(reason(s) for s in scenes)
    # Drawing the sidebar only at rest gives 6.4 views a second instead of 4.5 (Blender 5.2).
    if reasons != _last_reasons and not _moving(now):
        _last_reasons = reasons
        redraw(("UI",))
    return TICK_SECONDS


def _drawn_state(scene: bpy.types.Scene) -> tuple[Any, ...]:
    """The settings of a scene that its view shows."""
    props = settings_of(scene)
    return instant(scene), props.live_show, props.detail, props.develop, scene.frame_current


def _forget_closed_views(drawn: live.Session) -> None:
    """Drops the times, images and textures of views whose region no longer exists."""
    areas = [area for window in bpy.context.window_manager.windows for area in window.screen.areas]
    existing = {region.as_pointer() for area in areas for region in area.regions}
    for view in _moved.keys() - existing:
        del _moved[view]
        drawn.frames.pop(view, None)
        _shown.pop(view, None)


def _moving(now: float) -> bool:
    """True while a view changes."""
    return any(now - moved < _REST_SECONDS for moved in _moved.values())


def view_of(
    scene: bpy.types.Scene,
    shot: Path,
    size: tuple[int, int],
    matrices: tuple[Matrix, Matrix],
    t_star: float,
    pixels: int,
) -> contract.LiveView | None:
    """Request for a view's content; None for an orthographic view.

    Args:
        scene: the scene whose shot is drawn.
        shot: its shot folder.
        size: width and height of the region in pixels.
        matrices: world-to-view matrix and projection matrix, Blender's axes.
        t_star: frame number at which time stands still.
        pixels: maximum number of pixels to request.
    """
    window = np.array(matrices[1])
    if abs(window[3, 3]) > 1e-6:  # orthographic
        return None
    shrink = min(1.0, (pixels / max(1, size[0] * size[1])) ** 0.5)
    width, height = max(1, round(size[0] * shrink)), max(1, round(size[1] * shrink))
    viewmat, K = seen_camera.in_solve(scene, shot, matrices[0], matrices[1], width, height)
    return contract.LiveView(0, 0, viewmat, K, width, height, t_star, show=settings_of(scene).live_show)


def _same(first: contract.LiveView, second: contract.LiveView) -> bool:
    """True if both requests have the same content, regardless of size and plate detail."""
    instants = [(v.t_star, v.show, v.exposed_like, v.develop) for v in (first, second)]
    if instants[0] != instants[1]:
        return False
    ks = [np.array(v.K) / (v.width, v.height, v.width, v.height) for v in (first, second)]
    return bool(np.allclose(ks[0], ks[1], atol=2e-3) and np.allclose(first.viewmat, second.viewmat, atol=1e-6))


def _draw() -> None:
    """Draw handler of a region: requests its content and draws the newest frame."""
    context = bpy.context
    scene, region, view = scene_in(context), context.region, context.region_data
    if _session is None or view is None or selection.shot_folder(scene) != _session.shot:
        return
    t_star = instant(scene)
    if t_star is None:
        return
    key = region.as_pointer()
    size, matrices = (region.width, region.height), (view.view_matrix, view.window_matrix)
    quick, sharp = (view_of(scene, _session.shot, size, matrices, t_star, p) for p in (QUICK_PIXELS, SHARP_PIXELS))
    if quick is None or sharp is None:
        return
    # In the clip's camera, the image covers the plate and gets its exposure.
    if view.view_perspective == "CAMERA" and scene.camera == scene_objects.part(scene, _session.shot, "camera"):
        quick.exposed_like = sharp.exposed_like = float(scene.frame_current)
    quick.view = sharp.view = key
    sharp.detail = settings_of(scene).detail and sharp.show == "color"
    quick.develop = sharp.develop = settings_of(scene).develop
    _ask(key, quick, sharp)
    frame = _session.frames.get(key)
    if frame is not None:
        _paint(key, frame, view, scene_objects.depth_scale(scene, _session.shot))


def _ask(key: int, quick: contract.LiveView, sharp: contract.LiveView) -> None:
    """Requests the quick view if the content changed. Once it rests, requests the sharp view, then its detail."""
    if _session is None:
        return
    wanted, now = _session.wanted(key), time.monotonic()
    if wanted is None or not _same(wanted, quick):
        _moved[key] = now
        _rested.discard(key)
        _session.ask(quick)
    elif now - _moved[key] > _REST_SECONDS and not _session.busy(key):
        if wanted.width < sharp.width:
            _session.ask(dataclasses.replace(sharp, detail=wanted.detail))
        elif wanted.detail != sharp.detail:
            _session.ask(sharp)


def _paint(key: int, frame: live.Frame, view: bpy.types.RegionView3D, scale: float) -> None:
    """Draws a frame over the region, with a depth for each pixel."""
    shader = _shader_of()
    seq, colour, depth = _shown.get(key, (-1, None, None))
    if seq != frame.request.seq:
        h, w = frame.depth.shape
        colour = gpu.types.GPUTexture((w, h), format="RGBA16F", data=_buffer(frame.rgba))  # pyright: ignore[reportCallIssue]
        depth = gpu.types.GPUTexture((w, h), format="R32F", data=_buffer(frame.depth * np.float32(scale)))  # pyright: ignore[reportCallIssue]
        _shown[key] = (frame.request.seq, colour, depth)
    window = view.window_matrix
    batch = batch_for_shader(shader, "TRI_STRIP", {"pos": ((-1, -1), (1, -1), (-1, 1), (1, 1))})
    gpu.state.blend_set("ALPHA_PREMULT")
    gpu.state.depth_test_set("LESS_EQUAL")
    gpu.state.depth_mask_set(True)
    try:
        shader.bind()
        shader.uniform_sampler("colour", colour)
        shader.uniform_sampler("range", depth)
        shader.uniform_float("project", (window[2][2], window[2][3], window[3][2], window[3][3]))
        batch.draw(shader)
    finally:
        gpu.state.depth_mask_set(False)
        gpu.state.depth_test_set("NONE")
        gpu.state.blend_set("NONE")


def _buffer(values: np.ndarray) -> Any:
    values = np.ascontiguousarray(values, dtype=np.float32)
    return gpu.types.Buffer("FLOAT", values.size, values.ravel())  # pyright: ignore[reportCallIssue]


def _shader_of() -> Any:
    """The shader, compiled at the first draw."""
    global _shader
    if _shader is None:  # before the first draw there is no GPU context
        between = gpu.types.GPUStageInterfaceInfo("splannequin_frozen")  # pyright: ignore[reportCallIssue]
        between.smooth("VEC2", "at")
        info = gpu.types.GPUShaderCreateInfo()
        info.vertex_in(0, "VEC2", "pos")
        info.vertex_out(between)
        info.push_constant("VEC4", "project")
        info.sampler(0, "FLOAT_2D", "colour")
        info.sampler(1, "FLOAT_2D", "range")
        info.fragment_out(0, "VEC4", "painted")
        compat.declare_depth_write(info)
        info.vertex_source("void main() { at = vec2(pos.x, -pos.y) * 0.5 + 0.5; gl_Position = vec4(pos, 0.0, 1.0); }")
        info.fragment_source(
            """
            void main()
            {
              vec4 c = texture(colour, at);
              if (c.a < 0.01) { discard; }
              ivec2 size = textureSize(range, 0);
              float z = -texelFetch(range, clamp(ivec2(at * vec2(size)), ivec2(0), size - 1), 0).r;
              float clip = (project.x * z + project.y) / (project.z * z + project.w);
              gl_FragDepth = clamp(clip * 0.5 + 0.5, 0.0, 0.999999);
              /* Pictures are display-referred, the view's overlay takes linear light and encodes it. */
              vec3 shown = c.rgb / c.a;
              vec3 light = mix(shown / 12.92, pow((shown + 0.055) / 1.055, vec3(2.4)), step(vec3(0.04045), shown));
              painted = vec4(light * c.a, c.a);
            }
            """
        )
        _shader = gpu.shader.create_from_info(info)
    return _shader


@persistent
def _on_load(*_: object) -> None:
    """Handler: another file was loaded, so scrubbing ends."""
    end()


def register() -> None:
    """Registers the load handler."""
    bpy.app.handlers.load_post.append(_on_load)


def unregister() -> None:
    """Stops drawing and removes the load handler."""
    end()
    bpy.app.handlers.load_post.remove(_on_load)
