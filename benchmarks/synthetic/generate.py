"""Makes one scene from its seed: geometry of every frame, textures, cameras, and the list of pictures to render.

Writes to the scene's folder: geometry/static.npz, geometry/<name>.npz and <name>.npy (vertices [T, V, 3] of every
mover), textures/*.png, and finally plan.json, the input of render_bpy.py.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from torch_backend.footage.images import write_png
from torch_backend.shot import atomic_path, write_json

from .cameras import FOCAL_PER_WIDTH, CameraMove, intrinsics
from .geometry import Builder, Mesh, turn
from .hard import SceneObject, Staging, apple, arm_of, hair_of, share_in_view, stage
from .held import Held, cast, perform
from .noise import Array, stream
from .panes import GLASS, GLASS_INDEX, MIRROR, MIRROR_SHARE
from .places import Furnisher, Keepout, Place
from .sizes import Size, camera_move_of, place_of
from .textures import TEXTURES, halved

if TYPE_CHECKING:
    from .people import Bodies, Person

MAX_PEOPLE = 5
EXPOSURE_RAMP_STOPS = 1.2
SHUTTER_SECONDS = 0.06
"""Time between the first and the last row of a frame in `rolling-shutter`."""
SHUTTER_BANDS = 9
BEHIND_MARGIN = 6
"""Margin in pixels around a thing that is rendered without it."""
SHUTTER_FRAMES, SUBFRAMES, SUBFRAME_OVERSIZE = 0.5, 3, 2
"""For `held`: shutter time in frame intervals (a 180 degree shutter), number of pictures averaged over it, and greatest
`oversize` of these pictures. The camera moves by 2.5 px during the shutter at `quick`, so pictures are 0.8 px apart.
Each picture samples the pixels anew, which allows a smaller `oversize`."""
WALK_METRES = 3.2
"""Length in metres of the walk in `walker`. It goes against the camera's motion; with it, the walker would look
nearer."""


@dataclass
class Mover:
    """An object whose vertices change from frame to frame."""

    name: str
    vertices: NDArray[np.float32]
    """[T, V, 3] world coordinates in metres."""
    mesh: Mesh
    """Its triangles; the mesh's vertices are those of the first frame."""
    texture: str
    """File in textures/."""
    in_view: bool = True
    """False if only its shadow is visible."""


def frame_number(index: int) -> int:
    """Frame number of an index; numbers start at 1."""
    return index + 1


def frame_name(index: int) -> str:
    """File name of a frame."""
    return f"{frame_number(index):06d}.png"


def frame_seconds(size: Size) -> Array:
    """[T] times of the clip's frames in seconds."""
    return np.arange(size.frames) / size.fps


def camera_of(seed: int, size: Size, kind: str = "plain") -> CameraMove:
    """The camera path of the clip."""
    return CameraMove(camera_move_of(seed, kind), seed, (size.frames - 1) / size.fps)


def write_geometry(folder: Path, seed: int, kind: str, size: Size, key: str, bodies: Bodies) -> None:
    """Writes everything needed for rendering, with plan.json last."""
    seconds = frame_seconds(size)
    camera = camera_of(seed, size, kind)
    path = camera.eyes_and_targets(np.linspace(0.0, camera.duration, 60))[0][:, :2]
    staging = stage(kind, seed, path, camera.world_to_camera(np.linspace(0.0, camera.duration, 12)))
    scene = cast(seed, size, camera) if kind == "held" else None
    people = [part.person for part in scene.parts] if scene else _people(seed, kind, path, camera, staging)
    kept = [Keepout(*p.place, 0.45) for p in people] + staging.clear + (scene.clear if scene else [])
    kept += [Keepout(x, p.place[1], 0.45) for p in people if p.walks for x in np.linspace(*_ends(p), 8)]
    furnisher = Furnisher(seed, path, kept, staging.front_wall)
    movers: list[Mover] = []
    key_object: tuple[Array, Mesh, SceneObject] | None = None
    scene_object: SceneObject | None = None
    for person in people:
        body = bodies.make(person, seed, seconds)
        if kind == "still":
            body.vertices[:] = body.vertices[:1]
        elif person.walks:
            body.vertices += _walk(person, seconds, camera.duration)
        mesh = Mesh(body.vertices[0], body.triangles, body.uv, np.zeros(len(body.triangles), np.int32))
        movers.append(Mover(person.name, body.vertices, mesh, f"{person.name}.png"))
        write_png(folder / "textures" / f"{person.name}.png", body.texture)
        if body.seat:
            furnisher.stool(*body.seat, person.heading)
        if person.gesture:
            scene_object = arm_of(bodies, person.name)
        if kind == "hair" and person is people[0]:
            key_object = hair_of(folder, bodies, body, seed, seconds)
        if scene:
            for extra in perform(folder, scene.part_of(person), bodies, body, furnisher, seed, seconds):
                movers.append(Mover(extra[0], extra[1].astype(np.float32), extra[2], f"{extra[0]}.png"))
    if staging.apple:
        key_object = apple(folder, seed, seconds, staging.apple, path)
    if key_object:
        vertices, mesh, scene_object = key_object
        movers.append(Mover(scene_object.mover, vertices.astype(np.float32), mesh, f"{scene_object.mover}.png"))
    if scene:
        scene.furnish(furnisher)
    place, static = furnisher.room() if place_of(seed, kind) == "room" else furnisher.ground()
    if kind == "fast-mover":
        movers.append(_thrown_ball(folder, seed, seconds))
    if kind == "moving-shadow":
        movers.append(_shadow_board(folder, place, seconds, camera.duration))
    _write_textures(folder, seed, size, place)
    _write_mesh(folder / "geometry" / "static.npz", static)
    for mover in movers:
        _write_mesh(folder / "geometry" / f"{mover.name}.npz", mover.mesh)
        with atomic_path(folder / "geometry" / f"{mover.name}.npy") as partial:
            np.save(partial, mover.vertices, allow_pickle=False)
    if scene_object:
        with atomic_path(folder / "geometry" / "thing.npz") as partial:
            np.savez(partial, faces=scene_object.faces, gone=scene_object.gone)
    plan = _plan(key, seed, kind, size, camera, people, movers, scene_object, place)
    if scene:
        _write_held(folder, plan, size, camera, scene, movers)
    write_json(folder / "plan.json", plan)


def _write_held(
    folder: Path, plan: dict[str, Any], size: Size, camera: CameraMove, scene: Held, movers: list[Mover]
) -> None:
    """Writes geometry/held.npz; adds held things, pictures of their other state, and motion blur to the plan."""
    scene_objects = [scene_object for part in scene.parts for scene_object in part.objects]
    with atomic_path(folder / "geometry" / "held.npz") as partial:
        np.savez(
            partial, allow_pickle=False, **{scene_object.name: scene_object.faces for scene_object in scene_objects}
        )
    plan["held"] = [
        {"thing": scene_object.name, "mover": scene_object.mover} | part.to_json()
        for part in scene.parts
        for scene_object in part.objects
    ]
    plan["samples"] = max(1, round(size.samples / SUBFRAMES))
    plan["oversize"] = min(size.oversize, SUBFRAME_OVERSIZE)
    for job in plan["jobs"]:
        job["shutter"] = _shutter(job, size, camera)
    by_name = {mover.name: mover for mover in movers}
    plan["jobs"] = _with_behind(
        plan["jobs"], size, [(by_name[scene_object.mover], scene_object.faces) for scene_object in scene_objects]
    )
    for job in plan["jobs"]:
        if "box" in job:
            # These pictures are only compared by colour, so one moment is enough.
            job["shutter"] = job["shutter"][SUBFRAMES // 2 : SUBFRAMES // 2 + 1]
            job["elsewhen"] = {
                name: float(
                    np.clip(part.time_in_other_state(job["bands"][0]["time"] / size.fps) * size.fps, 0, size.frames - 1)
                )
                for part in scene.parts
                for name in part.movers
            }


def _shutter(job: dict[str, Any], size: Size, camera: CameraMove) -> list[dict[str, Any]]:
    """Moments over which a picture is averaged. Frozen scenes get the camera's blur, but no motion blur of movers."""
    offsets = SHUTTER_FRAMES * ((np.arange(SUBFRAMES) + 0.5) / SUBFRAMES - 0.5)
    pose = int(Path(job["out"]).stem) - 1
    views = camera.world_to_camera((pose + offsets) / size.fps)
    times = np.clip(job["bands"][0]["time"] + offsets, 0, size.frames - 1)
    if job["out"].startswith("truth/"):
        times = np.full(SUBFRAMES, job["bands"][0]["time"])
    return [{"time": float(t), "world_to_camera": v.tolist()} for t, v in zip(times, views, strict=True)]


def _plan(
    key: str,
    seed: int,
    kind: str,
    size: Size,
    camera: CameraMove,
    people: list[Person],
    movers: list[Mover],
    scene_object: SceneObject | None,
    place: Place,
) -> dict[str, Any]:
    """The content of plan.json, read by render_bpy.py."""
    plan: dict[str, Any] = {
        "key": key,
        "seed": seed,
        "kind": kind,
        "width": size.width,
        "height": size.height,
        "focal_per_width": FOCAL_PER_WIDTH,
        "samples": size.samples,
        "oversize": size.oversize,
        "sky": place.sky,
        "sky_strength": place.sky_strength,
        "sky_turn": place.sky_turn,
        "lights": place.lights,
        "materials": [{"file": m.file, "emission": m.emission} for m in place.materials],
        "movers": [{"name": m.name, "texture": m.texture, "in_view": m.in_view} for m in movers],
        "people": [{"name": p.name, "pose": p.pose, "phenotype": p.phenotype, "place": p.place} for p in people],
        "jobs": _jobs(seed, kind, size, camera),
    }
    # Written only if present, so that plans of other scenes stay identical byte for byte.
    if place.panes:
        plan["panes"] = [pane.to_json() for pane in place.panes]
        plan["reflects"] = {GLASS: GLASS_INDEX, MIRROR: MIRROR_SHARE}
    if scene_object:
        plan["thing"] = {"name": scene_object.name, "mover": scene_object.mover}
        if scene_object.gone.any():
            mover = next(m for m in movers if m.name == scene_object.mover)
            plan["jobs"] = _with_behind(plan["jobs"], size, [(mover, scene_object.faces)])
    return plan


def _write_textures(folder: Path, seed: int, size: Size, place: Place) -> None:
    for material in place.materials:
        texture, rng = TEXTURES[material.texture], stream(seed, "picture", material.texture, material.variant)
        write_png(
            folder / "textures" / material.file, halved(texture.draw(rng, 2 * texture.pixels // size.texture_step))
        )


def _write_mesh(path: Path, mesh: Mesh) -> None:
    with atomic_path(path) as partial:
        np.savez(partial, vertices=mesh.vertices, triangles=mesh.triangles, uv=mesh.uv, material=mesh.material)


# --------------------------------------------------------------------------------------------------- who and what


def _people(seed: int, kind: str, path: Array, camera: CameraMove, staging: Staging) -> list[Person]:
    """Two to five people (plain) or three, in view and away from the camera's path."""
    from .people import POSES, Person

    rng = stream(seed, "people")
    count = int(rng.integers(2, MAX_PEOPLE + 1)) if kind == "plain" else 3
    views = camera.world_to_camera(np.linspace(0.0, camera.duration, 12))
    poses = list(rng.permutation(list(POSES)))
    ages = [float(rng.uniform(0.62, 0.75)), float(rng.choice([rng.uniform(0.18, 0.34), rng.uniform(0.9, 1.0)]))]
    ages += [float(rng.choice([0.25, 0.67, 0.67, 0.95])) for _ in range(MAX_PEOPLE)]
    people: list[Person] = []
    for _ in range(4000):
        if len(people) == count:
            break
        x, y = float(rng.uniform(-2.4, 2.4)), float(rng.uniform(-1.6, 2.2))
        walks = kind == "walker" and not people
        if walks:
            x, y = float(np.copysign(0.5 * WALK_METRES, path[-1, 0] - path[0, 0])), 0.0
        of_the_scene = staging.first is not None and not people
        x, y = staging.first if staging.first and of_the_scene else (x, y)
        clear = np.hypot(path[:, 0] - x, path[:, 1] - y).min() > 0.85
        clear &= of_the_scene or all(np.hypot(k.x - x, k.y - y) > k.radius + 0.35 for k in staging.clear)
        is_clear = all(np.hypot(p.place[0] - x, p.place[1] - y) > 0.95 for p in people)
        placed = clear and is_clear and share_in_view(views, np.array([x, y, 1.0])) >= 0.5
        if not walks and not of_the_scene and not placed:
            continue
        to_camera = path[len(path) // 2] - [x, y]
        heading = float(np.arctan2(to_camera[0], -to_camera[1]) + np.radians(rng.normal(0.0, 40.0)))
        phenotype = {
            "gender": float(rng.uniform()),
            "age": ages[len(people)],
            "muscle": float(rng.uniform(0.35, 0.7)),
            "weight": float(rng.uniform(0.3, 0.7)),
            "height": float(rng.uniform(0.4, 0.6)),
            "proportions": float(rng.uniform(0.4, 0.8)),
        }
        accents = {"spine03": tuple(rng.normal(0.0, 2.0, 3)), "head": tuple(rng.normal(0.0, 5.0, 3))}
        waves = kind == "fast-mover" and not people
        pose = "wave" if waves else "stand" if walks or of_the_scene else poses[len(people)]
        heading = float(np.copysign(np.pi / 2, -x)) if walks else heading
        name = f"person{len(people)}"
        restless = float(rng.uniform(0.7, 1.4))
        gesture = ""
        if of_the_scene:
            restless, heading = 0.4 * restless, float(np.arctan2(to_camera[0], -to_camera[1]))
            gesture = ("wave", "point")[seed % 2] if kind == "arm" else ""
        people.append(Person(name, phenotype, pose, (x, y), heading, restless, waves, accents, gesture, walks))
    return people


def _walk(person: Person, seconds: Array, duration: float) -> NDArray[np.float32]:
    """[T, 1, 3] offset in metres of a walk to the mirrored position on the other side of the centre, in one clip."""
    begin, end = _ends(person)
    offset = np.zeros((len(seconds), 1, 3), np.float32)
    offset[:, 0, 0] = (end - begin) * seconds / duration
    return offset


def _ends(person: Person) -> tuple[float, float]:
    """(first, last) x in metres of a walking person."""
    return person.place[0], person.place[0] - float(np.copysign(WALK_METRES, person.place[0]))


def _thrown_ball(folder: Path, seed: int, seconds: Array) -> Mover:
    """A ball that bounces across the scene at 3 m/s or more."""
    rng = stream(seed, "ball")
    write_png(folder / "textures" / "ball.png", TEXTURES["fabric"].draw(rng, 512))
    builder = Builder([0.4])
    radius = 0.14
    builder.ball([0, 0, 0], [radius] * 3, 0, 28, 18)
    mesh = builder.mesh()
    phase = (seconds * 0.55 + 0.2) % 2.0
    x = np.where(phase < 1.0, -2.0 + 4.0 * phase, 6.0 - 4.0 * phase)
    z = radius + 1.6 * np.abs(np.sin(np.pi * 1.1 * seconds))
    at = np.stack([x, np.full_like(x, -0.5), z], 1)
    spin = np.array([turn(5.0 * s) for s in seconds])
    vertices = np.einsum("tij,vj->tvi", spin, mesh.vertices) + at[:, None]
    return Mover("ball", vertices.astype(np.float32), mesh, "ball.png")


def _shadow_board(folder: Path, place: Place, seconds: Array, duration: float) -> Mover:
    """A board, out of view, that moves between a strong lamp and the scene."""
    write_png(folder / "textures" / "board.png", np.full((8, 8, 3), 60, np.uint8))
    lamp = np.array([1.2, -3.8, 5.2])
    aim = np.array([0.0, 0.8, 0.6]) - lamp
    aim /= np.linalg.norm(aim)
    light = {"type": "SPOT", "location": lamp.tolist(), "direction": aim.tolist(), "size": [0.06, 1.3]}
    place.lights.append({**light, "energy": 2600.0, "color": [1.0, 0.93, 0.82], "portal": False})
    side = np.cross(aim, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side)
    up = np.cross(side, aim)
    builder = Builder([1.0])
    for offset in (-0.38, 0.0, 0.38):
        builder.rect(side * (offset - 0.08) - up * 0.8, side * 0.16, up * 1.6, 0)
    mesh = builder.mesh()
    at = lamp + 1.2 * aim + side * np.linspace(-0.8, 0.8, len(seconds))[:, None] * np.minimum(1.0, duration / 4.0)
    vertices = mesh.vertices[None] + at[:, None]
    return Mover("board", vertices.astype(np.float32), mesh, "board.png", in_view=False)


# --------------------------------------------------------------------------------------------------- what to render


def exposure_stops(kind: str, share: float) -> float:
    """Exposure offset in stops at `share` in [0, 1] of the clip."""
    return EXPOSURE_RAMP_STOPS * (share - 0.5) if kind == "exposure-ramp" else 0.0


def _jobs(seed: int, kind: str, size: Size, camera: CameraMove) -> list[dict[str, Any]]:
    """The clip's frames, each instant's frame followed by the truth of that instant."""
    seconds = frame_seconds(size)
    views = camera.world_to_camera(seconds)
    instants, poses = set(size.t_star_indices()), size.pose_indices()
    jobs = []
    for index in range(size.frames):
        jobs.append(_job(f"frames/{frame_name(index)}", seed, kind, size, index, index, views))
        if kind == "rolling-shutter":
            jobs[-1]["bands"] = _bands(size, camera, index)
        if index in instants:
            folder = f"truth/{frame_number(index):06d}"
            jobs += [_job(f"{folder}/{frame_name(p)}", seed, kind, size, index, p, views) for p in poses]
    return jobs


def _with_behind(
    jobs: list[dict[str, Any]], size: Size, scene_objects: Sequence[tuple[Mover, NDArray[np.bool_]]]
) -> list[dict[str, Any]]:
    """Inserts, after each truth that shows a thing, a picture of the background behind the things, cropped to them."""
    K, found = intrinsics(size.width, size.height), []
    for job in jobs:
        found.append(job)
        if not job["out"].startswith("truth/"):
            continue
        band = job["bands"][0]
        view = np.array(band["world_to_camera"])
        boxes = [
            _box_of(mover.vertices[round(band["time"])][np.unique(mover.mesh.triangles[faces])], view, K, size)
            for mover, faces in scene_objects
        ]
        boxes = [box for box in boxes if box is not None]
        if boxes:
            name = Path(job["out"])
            out = (name.parent / "behind" / name.name).as_posix()
            edges = np.array(boxes)
            low, high = edges[:, :2].min(axis=0), edges[:, 2:].max(axis=0)
            found.append({**job, "out": out, "box": [*map(int, low), *map(int, high)]})
    return found


def _box_of(points: NDArray[np.float32], view: Array, K: Array, size: Size) -> Array | None:
    """[4] left, top, right, bottom of points [P, 3] in a picture, with a margin; None if none of it is visible."""
    local = points @ view[:3, :3].T + view[:3, 3]
    pixels = (local[:, :2] / np.maximum(local[:, 2:], 0.05) * K[[0, 1], [0, 1]] + K[:2, 2])[local[:, 2] > 0.05]
    if len(pixels) == 0:
        return None
    least, most = np.zeros(2), np.array([size.width, size.height])
    low = np.clip(np.floor(pixels.min(axis=0)) - BEHIND_MARGIN, least, most)
    high = np.clip(np.ceil(pixels.max(axis=0)) + BEHIND_MARGIN, least, most)
    return np.concatenate([low, high]) if (high > low).all() else None


def _job(out: str, seed: int, kind: str, size: Size, time: int, pose: int, views: Array) -> dict[str, Any]:
    """One picture: the scene of frame `time` from the camera of frame `pose`. Equal pairs have equal noise."""
    band = {"rows": [0, size.height], "time": float(time), "world_to_camera": views[pose].tolist()}
    stops = exposure_stops(kind, time / (size.frames - 1))
    noise = int(stream(seed, "cycles", time, pose).integers(1 << 31))
    return {"out": out, "bands": [band], "stops": stops, "noise": noise}


def _bands(size: Size, camera: CameraMove, index: int) -> list[dict[str, Any]]:
    """Strips of rows, each with its own time around the frame's, in frames; the middle row is on time."""
    edges = np.linspace(0, size.height, min(SHUTTER_BANDS, size.height) + 1).round().astype(int)
    bands = []
    for low, high in itertools.pairwise(edges):
        late = (0.5 * (low + high) / size.height - 0.5) * SHUTTER_SECONDS
        view = camera.world_to_camera(np.array([index / size.fps + late]))[0]
        time = float(np.clip(index + late * size.fps, 0, size.frames - 1))
        bands.append({"rows": [int(low), int(high)], "time": time, "world_to_camera": view.tolist()})
    return bands
