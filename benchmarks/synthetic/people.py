"""People who hold still with slight drift: bodies from `anny`, posed, with procedural textures as clothes.

`anny` (PyPI, code Apache-2.0, MakeHuman data CC0) gives unclothed bodies from child to elder. Clothes are regions of
the skin displaced outwards by some millimetres and painted; hair is a cap made in the same way. Body frame: x to the
left hand, -y ahead, z up, metres. Angles are degrees about these axes.
"""

# Packages of requirements/bench.txt may be absent; each use handles that case.
# pyright: reportMissingImports=false

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from .geometry import turn
from .noise import Array, bumps, smooth_step, solid, stream, wander
from .rays import RayScene
from .textures import Picture, colour, halved, hsv

TEXTURE_SIZE = 1024
WAIST, KNEE = -0.06, -0.42
"""Heights in metres on the rest body, whose origin is in its pelvis."""
SKIN, SHIRT, TROUSERS, SHOES, HAIR, EYES = range(6)
FACE = ("eyeBlinkLeft", "eyeBlinkRight", "jawOpen", "mouthSmileLeft", "mouthSmileRight")
BLINK_SECONDS, FLIP_SECONDS = 0.3, 0.35
WAVE_HERTZ, POINT_HERTZ = 0.45, 0.3
"""Frequencies of the gestures."""

Pose = dict[str, tuple[float, float, float]]


def _both(pose: Pose) -> Pose:
    """A pose of the left limbs, completed with the mirrored right limbs."""
    mirrored = {k.removesuffix(".L") + ".R": (x, -y, -z) for k, (x, y, z) in pose.items()}
    return {**pose, **mirrored}


_ARMS_DOWN = _both({"upperarm01.L": (4, 30, 0), "lowerarm01.L": (22, 0, 0)})
_LEFT_DOWN = {k: v for k, v in _ARMS_DOWN.items() if k.endswith(".L")}
_SEATED_LEGS = _both({"upperleg01.L": (-84, -6, 0), "lowerleg01.L": (82, 0, 0)})

POSES: dict[str, Pose] = {
    "stand": _ARMS_DOWN,
    "contrapposto": {**_ARMS_DOWN, "upperleg01.L": (-14, -4, 0), "lowerleg01.L": (20, 0, 0), "spine05": (0, 3, 5)},
    "hips": _both({"upperarm01.L": (20, 4, 0), "lowerarm01.L": (35, 62, 20)}),
    "point": {**_LEFT_DOWN, "upperarm01.R": (-52, 10, 25), "lowerarm01.R": (36, 0, 0), "head": (0, 0, -12)},
    "wave": {**_LEFT_DOWN, "upperarm01.R": (0, 28, 0), "lowerarm01.R": (-35, 40, 0), "spine03": (0, 3, 0)},
    "phone": {**_LEFT_DOWN, "upperarm01.R": (-22, -22, 0), "lowerarm01.R": (-42, 0, 12), "neck01": (14, 0, -6)},
    "stride": {
        "upperleg01.L": (-26, 0, 0),
        "lowerleg01.L": (10, 0, 0),
        "upperleg01.R": (18, 0, 0),
        "lowerleg01.R": (26, 0, 0),
        "foot.R": (18, 0, 0),
        "upperarm01.L": (26, 28, 0),
        "upperarm01.R": (-24, -28, 0),
        "lowerarm01.L": (10, 0, 0),
        "lowerarm01.R": (-4, 0, 0),
    },
    "reach": {**_LEFT_DOWN, "upperarm01.R": (-20, 95, 0), "lowerarm01.R": (30, 0, 0), "head": (-16, 0, 0)},
    "bow": {**_ARMS_DOWN, "spine05": (22, 0, 0), "spine03": (10, 0, 0), "head": (-14, 0, 0)},
    "give": _both({"upperarm01.L": (-24, 22, 0), "lowerarm01.L": (-12, 0, 0)}),
    "sit": {**_SEATED_LEGS, **_both({"upperarm01.L": (-22, 26, 0), "lowerarm01.L": (-6, 0, 0)})},
    "sit_talk": {
        **_SEATED_LEGS,
        "upperarm01.L": (-20, 24, 0),
        "lowerarm01.L": (-8, 0, 0),
        "upperarm01.R": (-40, -12, 0),
        "lowerarm01.R": (-40, 0, 0),
        "spine05": (8, 0, 0),
    },
}
SEATED = ("sit", "sit_talk")


@dataclass(frozen=True)
class Person:
    """Position, pose and motion of a person."""

    name: str
    phenotype: dict[str, float]
    pose: str
    place: tuple[float, float]
    """x, y on the floor in metres."""
    heading: float
    """Radians about z; 0 faces -y."""
    restless: float = 1.0
    """Factor on all drift."""
    waves_arm: bool = False
    """True to swing the right arm up and down throughout, a limit of the method."""
    accents: Pose = field(default_factory=dict)
    """Angles added to the pose."""
    gesture: str = ""
    """Repeated gesture of the right arm from the pose `stand`: wave, point, or empty for none."""
    walks: bool = False
    """True to swing legs and arms as in walking, for which a freeze fails."""
    changes: tuple[tuple[float, float, Pose], ...] = ()
    """One-time changes (begin, end, pose after it), in seconds and in order, for kind `held`."""


@dataclass
class Body:
    """A person's body over the frames of a clip."""

    vertices: NDArray[np.float32]
    """[T, V, 3] world coordinates in metres."""
    triangles: NDArray[np.int32]
    """[F, 3]."""
    uv: NDArray[np.float32]
    """[F, 3, 2]."""
    texture: Picture
    """[N, N, 3] sRGB."""
    seat: tuple[float, float, float] | None
    """x, y and height of the seat in metres; None for a standing person."""


class Bodies:
    """The body model and data derived once from its topology. The first use on a machine takes a minute."""

    def __init__(self, texture_step: int = 1) -> None:
        import anny

        self.texture_size = 2 * TEXTURE_SIZE // texture_step
        self.model = anny.Anny(facial_actions=list(FACE))
        self.bones: list[str] = list(self.model.bone_labels)
        coordinates, corners = self.model.texture_coordinates, self.model.face_texture_coordinate_indices
        assert coordinates is not None and corners is not None
        self.triangles = self.model.faces.numpy().astype(np.int32)
        self.uv = coordinates.numpy()[corners.numpy()].astype(np.float32)
        unposed = self.model(phenotype_kwargs={**dict.fromkeys(self.model.phenotype_labels, 0.5), "age": 0.67})
        self.rest_vertices: Array = unposed["vertices"][0].numpy()
        """[V, 3] the unposed body of an adult, on which clothes are defined and painted."""
        self.eye: Array = unposed["bone_poses"][0, self.bones.index("eye.L"), :3, 3].numpy()
        """[3] centre of its left eye."""
        self.influence = self._influence()
        self.regions = self._regions()
        self.texels = self._texels()

    def _influence(self) -> dict[str, Array]:
        """{group: [V] skinning weight of a group of bones}."""
        weights, bones = self.model.vertex_bone_weights.numpy(), self.model.vertex_bone_indices.numpy()

        def of(*stems: str, end: str = "") -> Array:
            chosen = np.array([bone.startswith(stems) and bone.endswith(end) for bone in self.bones])
            return np.where(chosen[bones], weights, 0.0).sum(axis=1)

        return {
            "right_arm": of("upperarm", "lowerarm", "wrist", "finger", "metacarpal", end=".R"),
            "right_hand": of("wrist", "finger", "metacarpal", end=".R"),
            "arms": of("upperarm", "lowerarm", "wrist", "finger", "metacarpal"),
            "chest": of("spine01", "spine02", "spine03"),
            "hips": of("root", "pelvis"),
            "upper_arms": of("upperarm"),
            "forearms": of("lowerarm"),
            "neck": of("neck", "head", "eye."),
            "thighs": of("upperleg"),
            "feet": of("foot", "toe"),
            "head": of("head", "neck02", "neck03"),
            "eyes": of("eye."),
        }

    def _regions(self) -> dict[str, Array]:
        """{name: [V] soft field over the body}; clothes and hair begin where it exceeds 0.5."""
        z, y = self.rest_vertices[:, 2], self.rest_vertices[:, 1]
        w = self.influence
        # The hair line falls from the forehead to the nape. The unit is half the distance between the eyes.
        unit = self.eye[0]
        hair_line = (z - self.eye[2] - 1.9 * unit) - 0.8 * (self.eye[1] - 0.3 * unit - y)
        above_waist = np.clip((z - WAIST) / 0.02 + 0.5, 0.0, 1.0)
        body = 1.0 - np.maximum(w["arms"], w["neck"])
        return {
            "sleeveless": body * above_waist,
            "upper_arms": w["upper_arms"],
            "forearms": w["forearms"],
            "legs": body * (1.0 - above_waist) - w["feet"],
            "thighs": body * (1.0 - above_waist) * np.clip((z - KNEE) / 0.02 + 0.5, 0.0, 1.0),
            "feet": w["feet"],
            "hair": np.where(w["head"] + w["eyes"] > 0.5, np.clip(0.5 + hair_line / 0.015, 0.0, 1.0), 0.0),
            "eyes": w["eyes"],
        }

    def _texels(self) -> tuple[NDArray[np.int32], NDArray[np.float32], NDArray[np.int64]]:
        """Triangle of each texel: (face [N*N], barycentric [N*N, 3], nearest covered texel [N*N])."""
        flat = np.concatenate([self.uv.reshape(-1, 2), np.zeros((3 * len(self.uv), 1), np.float32)], axis=1)
        size = self.texture_size
        at = ((np.arange(size) + 0.5) / size).astype(np.float32)
        v, u = np.meshgrid(1.0 - at, at, indexing="ij")
        origins = np.stack([u.ravel(), v.ravel(), np.ones(u.size, np.float32)], axis=1)
        down = np.broadcast_to(np.array([0, 0, -1], np.float32), origins.shape)
        hits = RayScene(flat, np.arange(len(flat), dtype=np.int32).reshape(-1, 3)).cast(origins, down)
        empty = (hits.face < 0).reshape(size, size)
        nearest = distance_transform_edt(empty, return_distances=False, return_indices=True)
        assert nearest is not None
        return hits.face, hits.barycentric, np.ravel_multi_index(tuple(nearest), empty.shape).ravel()

    def make(self, person: Person, seed: int, seconds: Array) -> Body:
        """The body of a person at times [T]."""
        rng = stream(seed, person.name, "clothes")
        clothes = Clothes(
            sleeves=int(rng.integers(0, 3)),
            dress=bool(rng.uniform() < 0.25),
            bald=person.phenotype["age"] > 0.85 and bool(rng.uniform() < 0.4),
        )
        vertices = self._skinned(person, stream(seed, person.name, "drift"), seconds)
        region, thickness = self._dressed(clothes, stream(seed, person.name, "folds"))
        normals = self._normals(vertices)
        breath = 0.5 + 0.5 * np.sin(2 * np.pi * seconds / rng.uniform(3.0, 4.5) + rng.uniform(0, 6))
        lift = 0.004 * person.restless * self.influence["chest"][None] * breath[:, None]
        vertices = vertices + normals * (thickness[None] + lift)[..., None]
        vertices[..., 2] -= vertices[0, :, 2].min()
        vertices = self._sway(person, stream(seed, person.name, "sway"), seconds, vertices)
        world = vertices @ turn(person.heading).T + np.array([*person.place, 0.0])
        seat = None
        if person.pose in SEATED:
            under = world[
                :, (self.influence["hips"] + self.influence["thighs"] > 0.9) & (self.rest_vertices[:, 2] > -0.2)
            ]
            x, y = under[0, :, :2].mean(axis=0)
            seat = float(x), float(y), float(under[..., 2].min())
        texture = self._texture(clothes, region, stream(seed, person.name, "colours"))
        return Body(world.astype(np.float32), self.triangles, self.uv, texture, seat)

    def _skinned(self, person: Person, rng: np.random.Generator, seconds: Array) -> Array:
        """[T, V, 3] vertices in the body frame: the pose with drifting and twitching joints."""
        count = len(seconds)
        angles = {
            bone: np.tile(np.asarray(value, np.float64), (count, 1)) for bone, value in POSES[person.pose].items()
        }

        def add(bone: str, degrees: Array) -> None:
            angles[bone] = angles.get(bone, np.zeros((count, 3))) + degrees

        for begin, end, after in person.changes:
            share = smooth_step(seconds, begin, end)[:, None]
            for bone, value in after.items():
                before = angles.get(bone, np.zeros((count, 3)))
                angles[bone] = before + share * (np.asarray(value, np.float64) - before)
        r = person.restless
        for bone, value in person.accents.items():
            add(bone, np.asarray(value, np.float64))
        # Slow drift over seconds, as of tiring muscles, then sway and tremor.
        for side in (".L", ".R"):
            add("upperarm01" + side, r * np.array([2.2, 1.6, 0.8]) * wander(rng, seconds, 7.0, 3))
            add("lowerarm01" + side, r * np.array([2.2, 0.8, 0.8]) * wander(rng, seconds, 5.0, 3))
            add("wrist" + side, r * 1.5 * wander(rng, seconds, 2.0, 3))
            add("wrist" + side, r * 0.8 * wander(rng, seconds, 0.2, 3))
        add("spine05", r * np.array([0.9, 0.7, 0.9]) * wander(rng, seconds, 5.0, 3))
        add("spine02", r * np.array([0.5, 0.5, 0.5]) * wander(rng, seconds, 3.0, 3))
        add("neck01", r * np.array([1.5, 1.0, 3.5]) * wander(rng, seconds, 6.0, 3))
        add("head", r * np.array([1.2, 0.8, 2.0]) * wander(rng, seconds, 3.0, 3))
        # Quick small changes: a twitch of the head and a flick of a hand.
        add("head", r * np.array([4.0, 0.0, 5.0]) * bumps(rng, seconds, 4.0, FLIP_SECONDS)[:, None])
        add("wrist.L", r * np.array([18.0, 0.0, 6.0]) * bumps(rng, seconds, 3.0, FLIP_SECONDS)[:, None])
        if person.waves_arm:
            swing = np.sin(2 * np.pi * 0.9 * seconds)[:, None]
            add("upperarm01.R", np.array([-10.0, 45.0, 0.0]) * (0.5 + 0.5 * swing))
            add("lowerarm01.R", np.array([-20.0, 35.0, 0.0]) * swing)
        for bone, degrees in _gesture(person.gesture, seconds).items():
            add(bone, degrees)
        if person.walks:
            swing = np.sin(2 * np.pi * 0.9 * seconds)[:, None]
            for side, sign in ((".L", 1.0), (".R", -1.0)):
                add("upperleg01" + side, np.array([26.0 * sign, 0.0, 0.0]) * swing)
                add("lowerleg01" + side, np.array([22.0, 0.0, 0.0]) * np.clip(sign * swing, 0.0, 1.0))
                add("upperarm01" + side, np.array([-22.0 * sign, 0.0, 0.0]) * swing)
        rotations = np.tile(np.eye(4), (count, len(self.bones), 1, 1))
        for bone, degrees in angles.items():
            rotations[:, self.bones.index(bone), :3, :3] = _rotations(np.radians(degrees))
        blink = bumps(rng, seconds, 3.5, BLINK_SECONDS)
        face = {
            "eyeBlinkLeft": blink,
            "eyeBlinkRight": blink,
            "jawOpen": np.clip(0.12 + 0.1 * wander(rng, seconds, 6.0)[:, 0], 0.0, 1.0),
            "mouthSmileLeft": np.full(count, rng.uniform(0.0, 0.8)),
            "mouthSmileRight": np.full(count, rng.uniform(0.0, 0.8)),
        }
        with torch.no_grad():
            out = self.model(
                pose_parameters=torch.from_numpy(rotations),
                phenotype_kwargs=person.phenotype,
                facial_actions={name: torch.from_numpy(value) for name, value in face.items()},
            )
        return out["vertices"].numpy().astype(np.float64)

    def _sway(self, person: Person, rng: np.random.Generator, seconds: Array, vertices: Array) -> Array:
        """Tilts the body about its feet (moved to the origin) by fractions of a degree; a fifth of that when seated."""
        r = person.restless * (0.2 if person.pose in SEATED else 1.0)
        tilt = np.radians(r * np.array([0.45, 0.35, 0.25]) * wander(rng, seconds, 3.5, 3))
        feet = vertices[0, self.influence["feet"] > 0.5].mean(axis=0) * [1.0, 1.0, 0.0]
        return np.einsum("tij,tvj->tvi", _rotations(tilt), vertices - feet)

    def _dressed(self, clothes: Clothes, rng: np.random.Generator) -> tuple[Array, Array]:
        """(soft fields [V, 6] per region, thickness [V] of cloth and hair in metres)."""
        f = self.regions
        shirt = f["sleeveless"] + f["upper_arms"] * (clothes.sleeves > 0) + f["forearms"] * (clothes.sleeves > 1)
        trousers = f["legs"]
        if clothes.dress:
            shirt, trousers = shirt + f["thighs"], np.zeros_like(trousers)
        hair = np.zeros_like(f["hair"]) if clothes.bald else f["hair"]
        fields = np.stack([np.full(len(shirt), 0.5), shirt, trousers, f["feet"], hair, f["eyes"]], axis=1)
        folds = solid(int(rng.integers(1 << 30)), self.rest_vertices * [1.0, 1.0, 0.6], 0.06)
        strands = solid(int(rng.integers(1 << 30)), self.rest_vertices, 0.03)
        soft = np.clip(4.0 * (fields - 0.5), 0.0, 1.0)
        thickness = soft[:, SHIRT] * (0.007 + 0.012 * folds) + soft[:, TROUSERS] * (0.008 + 0.013 * folds)
        thickness += soft[:, SHOES] * 0.008 + soft[:, HAIR] * (0.012 + 0.02 * strands)
        return fields, np.where(self.influence["eyes"] > 0.5, 0.0, thickness)

    def _normals(self, vertices: Array) -> Array:
        """[T, V, 3] unit vertex normals, weighted by area."""
        corners = torch.from_numpy(vertices)[:, torch.from_numpy(self.triangles.astype(np.int64))]
        face = torch.linalg.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
        total = torch.zeros(vertices.shape, dtype=torch.float64)
        for k in range(3):
            total.index_add_(1, torch.from_numpy(self.triangles[:, k].astype(np.int64)), face)
        return torch.nn.functional.normalize(total, dim=2).numpy()

    def _texture(self, clothes: Clothes, fields: Array, rng: np.random.Generator) -> Picture:
        """Paints every texel by region and position of its point on the rest body."""
        face, weights, nearest = self.texels
        used = np.flatnonzero(face >= 0)
        corner = self.triangles[face[used]]
        at = np.einsum("nk,nkd->nd", weights[used], self.rest_vertices[corner])
        soft = np.einsum("nk,nkr->nr", weights[used], fields[corner])
        region = soft.argmax(axis=1)
        rgb = np.zeros((len(used), 3))
        for index, paint in enumerate((_skin, _cloth, _cloth, _leather, _hair, _eyes)):
            inside = region == index
            if inside.any():
                rgb[inside] = paint(rng, at[inside], self.eye)
        size = self.texture_size
        picture = np.zeros((size * size, 3))
        picture[used] = rgb
        picture = picture[nearest].reshape(size, size, 3)
        return halved(np.round(255.0 * np.clip(picture, 0.0, 1.0)).astype(np.uint8))


@dataclass(frozen=True)
class Clothes:
    """Clothes and hair of a person."""

    sleeves: int
    """0 for none, 1 to the elbow, 2 to the wrist."""
    dress: bool
    bald: bool


def _gesture(gesture: str, seconds: Array) -> dict[str, Array]:
    """{bone: [T, 3] degrees added to the pose `stand`} for a waving hand, or an arm that points and sinks."""
    if not gesture:
        return {}
    of_arm = {bone: np.subtract(POSES[gesture][bone], _ARMS_DOWN[bone]) for bone in ("upperarm01.R", "lowerarm01.R")}
    if gesture == "point":
        share = 0.6 - 0.4 * np.cos(2 * np.pi * POINT_HERTZ * seconds)
        return {bone: share[:, None] * degrees for bone, degrees in of_arm.items()}
    swing = np.sin(2 * np.pi * WAVE_HERTZ * seconds)[:, None]
    swings = {"upperarm01.R": np.array([0.0, 14.0, 0.0]), "lowerarm01.R": np.array([0.0, 32.0, 0.0])}
    return {bone: degrees + swing * swings[bone] for bone, degrees in of_arm.items()}


def _rotations(vectors: Array) -> Array:
    """Rotation matrices [..., 3, 3] of rotation vectors [..., 3] in radians (Rodrigues)."""
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    k = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*vectors.shape[:-1], 3, 3)
    small = angle < 1e-8
    safe = np.where(small, 1.0, angle)
    first, second = np.where(small, 1.0, np.sin(safe) / safe), np.where(small, 0.5, (1 - np.cos(safe)) / safe**2)
    return np.eye(3) + first * k + second * (k @ k)


def _skin(rng: np.random.Generator, at: Array, eye: Array) -> Array:
    """Skin colours with freckles, brows and lips; `eye` is the centre of the left eye."""
    tone = hsv(rng.uniform(0.05, 0.08), rng.uniform(0.35, 0.55), rng.uniform(0.45, 0.9))
    patches = 0.85 + 0.3 * solid(int(rng.integers(1 << 30)), at, 0.04)
    freckles = np.where(solid(int(rng.integers(1 << 30)), at, 0.008) > 0.8, 0.8, 1.0)
    rgb = tone * (patches * freckles)[:, None]
    across, up = np.abs(at[:, 0]) / eye[0], (at[:, 2] - eye[2]) / eye[0]
    front = at[:, 1] < eye[1] + eye[0]
    rgb[front & (np.abs(across - 1.05) < 0.65) & (np.abs(up - 0.85) < 0.16)] = tone * 0.25
    rgb[front & ((across / 0.8) ** 2 + ((up + 2.15) / 0.28) ** 2 < 1.0)] = tone * [0.95, 0.55, 0.55]
    return rgb


def _cloth(rng: np.random.Generator, at: Array, _eye: Array) -> Array:
    """One of several patterns, defined on the rest body so that it moves with the wearer."""
    a, b, c = (colour(rng, (0.2, 0.85), (0.2, 0.95)) for _ in range(3))
    kind, pitch = rng.integers(5), rng.uniform(0.045, 0.08)
    x, y, z = at.T
    around = np.arctan2(y, x)
    seed = int(rng.integers(1 << 30))
    if kind == 0:
        share = (np.sin(2 * np.pi * z / pitch) > 0).astype(np.float64)
    elif kind == 1:
        share = 0.5 * (np.sin(2 * np.pi * z / pitch) > 0) + 0.5 * (np.sin(2 * np.pi * x / pitch) > 0)
    elif kind == 2:
        cell = np.stack([x, y, z], 1) / pitch
        share = (np.linalg.norm(cell - np.round(cell), axis=1) < 0.33).astype(np.float64)
    elif kind == 3:
        share = np.round(3 * solid(seed, at, 0.06)) / 3
    else:
        share = (np.sin(2 * np.pi * (z + 0.03 * np.sin(6 * around)) / pitch) > 0.2).astype(np.float64)
    rgb = a * (1 - share)[:, None] + b * share[:, None]
    rgb[solid(seed + 1, at, 0.025) > 0.78] = c
    return rgb * (0.8 + 0.35 * solid(seed + 2, at, 0.006))[:, None]


def _leather(rng: np.random.Generator, at: Array, _eye: Array) -> Array:
    tone = colour(rng, (0.0, 0.6), (0.12, 0.6))
    return tone * (0.7 + 0.6 * solid(int(rng.integers(1 << 30)), at, 0.02))[:, None]


def _hair(rng: np.random.Generator, at: Array, _eye: Array) -> Array:
    tone = hsv(rng.uniform(0.03, 0.12), rng.uniform(0.1, 0.7), rng.uniform(0.12, 0.7))
    return tone * (0.45 + 0.9 * solid(int(rng.integers(1 << 30)), at * [2.5, 1.0, 0.5], 0.008))[:, None]


def _eyes(rng: np.random.Generator, at: Array, eye: Array) -> Array:
    """White with a dark iris that looks ahead."""
    out = np.hypot(np.abs(at[:, 0]) - eye[0], at[:, 2] - eye[2])
    rgb = np.full((len(at), 3), 0.92)
    rgb[out < 0.0062] = colour(rng, (0.3, 0.7), (0.2, 0.6))
    rgb[out < 0.003] = 0.03
    return rgb
