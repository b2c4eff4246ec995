"""Kind `held`: things that are still for seconds in one state, change within a second, and are still in another.

Optical flow between neighbouring frames finds no motion in either state. Each scene has three people, each with one of
five roles (`ROLES`), chosen by the seed (`CAST`). Every change is between two instants t*, so that nothing changes at
an instant. Metres, z up; times in seconds of the clip.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from torch_backend.footage.images import write_png

from .cameras import CameraMove
from .geometry import Builder, Mesh
from .hard import SceneObject, share_in_view
from .noise import Array, fractal, smooth_step, stream
from .places import Furnisher, Keepout
from .sizes import Size

if TYPE_CHECKING:
    from .people import Bodies, Body, Person, Pose

RAISED, TURNED, RESTING, LEAVING, SET_DOWN = "raised", "turned", "resting", "leaving", "set_down"
ROLES = (RAISED, TURNED, RESTING, LEAVING, SET_DOWN)
"""raised: an arm is raised once and stays up (with even seeds before a panel of its colours). turned: a head turns
while a column hides it from the camera. resting: a hand rests on a table and leaves it. leaving: a person walks into a
cubicle and stays. set_down: a box is held and then set down."""
CAST = (
    (RAISED, RESTING, LEAVING),
    (RAISED, RESTING, SET_DOWN),
    (RAISED, TURNED, LEAVING),
    (RAISED, TURNED, SET_DOWN),
    (RAISED, RESTING, SET_DOWN),
    (RAISED, LEAVING, SET_DOWN),
    (RAISED, TURNED, SET_DOWN),
    (TURNED, RESTING, LEAVING),
    (RAISED, LEAVING, SET_DOWN),
    (RAISED, RESTING, LEAVING),
)
"""Roles by `seed % 10`. `turned` needs a camera that goes and returns or orbits (`seed % 4` of 2 or 3): one that walks
forward or pans cannot pass a column and see both states."""
CHANGE_SECONDS = {RAISED: 0.6, TURNED: 0.6, RESTING: 0.6, LEAVING: 1.2, SET_DOWN: 1.0}
"""Duration of each change in seconds: an unhurried arm movement; a walk of 1.5 m at 1.3 m/s."""
REST_SECONDS = 0.5
"""Least seconds between a change and an instant, if the clip is long enough."""
RESTLESS = 0.2
"""Factor on these people's sway: 95 % of their vertices stay within 3 cm during a state (4 cm with 0.3)."""
SPOTS, GOOD_SPOTS, LAYOUTS = 400, 150, 20
"""Number of random places tried for a role, number of the best ones kept, and number of random layouts of these.
Layouts are improved place by place; the one with the best view of every role is used."""
COLUMN_SHARE = 0.45
"""Position of the column on the line from head to camera. A column nearer to the camera hides more than the head."""
HEAD_RADIUS, ARM_RADIUS = 0.13, 0.4
"""Radius in metres, around a head and around other held things, that should be visible."""
COLUMN_HEIGHT = 2.1
PANEL_SIZE, PANEL_BEHIND = (1.9, 0.06, 2.3), 0.5
"""Width, depth and height in metres of the panel in the arm's colours, and its distance behind the person."""
CUBICLE, WALK_METRES = 1.0, 1.5
"""Side of the cubicle in metres, and distance of its centre from the starting point of the leaving person."""
CUBICLE_HEIGHT = 2.2
BOX_SIZE = (0.2, 0.2, 0.24)

_ARM_DOWN: Pose = {"upperarm01.R": (4, -30, 0), "lowerarm01.R": (22, 0, 0)}
_ARM_UP: tuple[Pose, ...] = (
    {"upperarm01.R": (-20, 95, 0), "lowerarm01.R": (30, 0, 0)},
    {"upperarm01.R": (0, 28, 0), "lowerarm01.R": (-35, 40, 0)},
    {"upperarm01.R": (-10, 60, 0), "lowerarm01.R": (0, 0, 0)},
)
_HAND_ON_TABLE: Pose = {"upperarm01.R": (-22, -16, 0), "lowerarm01.R": (-14, 0, 0)}
_HAND_UP: Pose = {"upperarm01.R": (-22, 22, 0), "lowerarm01.R": (-62, 0, 12)}
_HOLDS: Pose = {"upperarm01.R": (-20, -10, 0), "lowerarm01.R": (-52, 0, 0)}
_OVER_TABLE: Pose = {"upperarm01.R": (-30, -16, 0), "lowerarm01.R": (-6, 0, 0)}
_HEAD_TURN: Pose = {"neck01": (0, 0, 18), "head": (0, 0, 22)}
_STRIDE: Pose = {
    "upperleg01.L": (-24, 0, 0),
    "lowerleg01.L": (10, 0, 0),
    "upperleg01.R": (16, 0, 0),
    "lowerleg01.R": (24, 0, 0),
}
_MIRRORED_STRIDE: Pose = {bone[:-1] + ("R" if bone.endswith("L") else "L"): v for bone, v in _STRIDE.items()}
_LEGS_DOWN: Pose = dict.fromkeys(_STRIDE, (0, 0, 0))


@dataclass
class Part:
    """One role of a scene and the person who has it."""

    role: str
    person: Person
    begin: float
    """Seconds at which the change begins."""
    end: float
    """Seconds at which the change ends."""
    objects: list[SceneObject] = field(default_factory=list)
    """The held thing, as triangles of a mover; set by `perform`."""
    movers: list[str] = field(default_factory=list)
    """Names of all movers changed by the role; set by `perform`."""

    def time_in_other_state(self, seconds: float) -> float:
        """A time in the other state, for a state at `seconds`."""
        return self.end + 0.25 if seconds < 0.5 * (self.begin + self.end) else self.begin - 0.25

    def to_json(self) -> dict[str, object]:
        """The role's entry in plan.json."""
        return {"name": self.role, "movers": self.movers, "begin": self.begin, "end": self.end}


@dataclass
class Held:
    """The roles of one scene, and the positions of its furniture."""

    parts: list[Part]
    clear: list[Keepout]
    """Ground kept free for people, props and lines of sight."""
    columns: list[tuple[float, float, float]]
    """x, y and radius of the columns that hide a head while it turns."""

    def part_of(self, person: Person) -> Part:
        """The role of a person."""
        return next(part for part in self.parts if part.person is person)

    def furnish(self, furnisher: Furnisher) -> None:
        """Adds columns and cubicles."""
        for x, y, radius in self.columns:
            furnisher.build.cylinder([x, y, 0.0], radius, COLUMN_HEIGHT, furnisher.material("bricks"))
        for part in self.parts:
            if part.role == LEAVING:
                x, y = _walks_to(part.person.place, part.person.heading)
                size = [CUBICLE, CUBICLE, CUBICLE_HEIGHT]
                furnisher.build.box([x, y, CUBICLE_HEIGHT / 2], size, furnisher.material("fabric"), part.person.heading)


def change_times(size: Size, role: str, rng: np.random.Generator) -> tuple[float, float]:
    """(begin, end) of a change in seconds, at or near the middle between two instants.

    With a single instant the change is before it. If no gap between instants is long enough (`paper`), the change is in
    the middle third of the clip.
    """
    length, duration = CHANGE_SECONDS[role], (size.frames - 1) / size.fps
    instants = [index / size.fps for index in size.t_star_indices()]
    gaps = [(a, b) for a, b in itertools.pairwise(instants) if b - a > length]
    if len(instants) == 1:
        gaps = [(0.0, instants[0])]
    begin, end = gaps[int(rng.integers(len(gaps)))] if gaps else (duration / 3, 2 * duration / 3)
    spare = max(0.0, 0.5 * (end - begin - length) - REST_SECONDS)
    middle = 0.5 * (begin + end) + spare * float(rng.uniform(-1.0, 1.0))
    return middle - 0.5 * length, middle + 0.5 * length


# ------------------------------------------------------------------------------------------------- who stands where


@dataclass
class _Spot:
    """Place of a role in one candidate layout."""

    place: Array
    """[2] position in metres."""
    middle: Array
    """[2] mean position of the held thing in its two states."""
    heading: float
    solid: list[Array]
    """Discs (x, y, radius) of the person and the props, which block views."""
    column: Array | None = None
    """The disc that may hide its own person, or None."""


def cast(seed: int, size: Size, camera: CameraMove) -> Held:
    """Assigns roles, places and times."""
    rng = stream(seed, "held")
    roles = CAST[seed % 10]
    times = [change_times(size, role, rng) for role in roles]
    seconds = np.linspace(0.0, camera.duration, 24)
    views = camera.world_to_camera(seconds)
    eyes = _eyes(views)
    choices: list[list[_Sight]] = []
    for role, time in zip(roles, times, strict=True):
        tried = [_spot(role, time, seed, camera, eyes, rng) for _ in range(SPOTS)]
        fits = [_Sight.of(spot, time, seconds, views) for spot in tried if spot]
        choices.append(sorted(fits, key=lambda sight: -sight.shown([]))[:GOOD_SPOTS])
    spots = [sight.spot for sight in _layout(choices, rng)]
    parts = [
        Part(role, _person(seed, number, role, spot, time), *time)
        for number, (role, spot, time) in enumerate(zip(roles, spots, times, strict=True))
    ]
    clear = [Keepout(float(x), float(y), float(r) + 0.1) for spot in spots for x, y, r in spot.solid]
    for spot, (eye, share) in itertools.product(spots, itertools.product(eyes[::6], np.arange(0.3, 0.9, 0.1))):
        at = spot.place + share * (eye - spot.place)
        clear.append(Keepout(float(at[0]), float(at[1]), 0.2))
    columns = [(float(s.column[0]), float(s.column[1]), float(s.column[2])) for s in spots if s.column is not None]
    return Held(parts, clear, columns)


def _spot(
    role: str, time: tuple[float, float], seed: int, camera: CameraMove, eyes: Array, rng: np.random.Generator
) -> _Spot | None:
    """A random place for a role with its props; None if it blocks the camera or exceeds the room."""
    place = np.array([rng.uniform(-2.3, 2.3), rng.uniform(-1.4, 2.2)])
    offset = eyes[len(eyes) // 2] - place
    offset = offset / np.linalg.norm(offset)
    facing = float(np.arctan2(offset[0], -offset[1]))
    # The body faces (sin, -cos) of its heading. If it is turned to its left, the right arm is nearer to the camera.
    turned = {RAISED: 0.0, TURNED: 0.0, RESTING: 40.0, SET_DOWN: 55.0}
    solid, column = [np.array([*place, 0.3])], None
    if role == LEAVING:
        side = float(rng.choice([-1.0, 1.0]))
        heading = float(facing + side * np.pi / 2)
        booth = np.array([*_walks_to((place[0], place[1]), heading), 0.72 * CUBICLE])
        solid.append(booth)
        if abs(booth[0]) > 2.8 or booth[1] > 2.5:
            return None
    else:
        heading = facing + np.radians(turned[role])
    forward = np.array([np.sin(heading), -np.cos(heading)])
    right = np.array([-np.cos(heading), -np.sin(heading)])
    middle = place + {RAISED: 0.3 * right, RESTING: 0.25 * forward, SET_DOWN: 0.25 * forward}.get(role, 0.0 * forward)
    if role in (RESTING, SET_DOWN):
        solid.append(np.array([*(place + 0.45 * forward), 0.35]))
    if role == RAISED and seed % 2 == 0:
        solid.append(np.array([*(place - PANEL_BEHIND * offset), 0.5]))
    if role == TURNED:
        column = _column(place, 0.5 * sum(time), camera)
        solid.append(column)
    if any(np.hypot(*(eyes - disc[:2]).T).min() < disc[2] + 0.75 for disc in solid):
        return None
    return _Spot(place, middle, heading, solid, column)


def _column(place: Array, middle: float, camera: CameraMove) -> Array:
    """[3] x, y, radius of a column that hides a head from 0.4 s before to 0.4 s after the middle of its turn."""
    views = camera.world_to_camera(middle + np.linspace(-0.4, 0.4, 9))
    eyes = _eyes(views)
    at = place + COLUMN_SHARE * (eyes[4] - place)
    lines = (eyes - place) / np.linalg.norm(eyes - place, axis=1, keepdims=True)
    distance = np.abs(lines[:, 0] * (at - place)[1] - lines[:, 1] * (at - place)[0]).max()
    return np.array([*at, distance + HEAD_RADIUS * (1.0 - COLUMN_SHARE)])


def _walks_to(place: tuple[float, float], heading: float) -> tuple[float, float]:
    """x, y of the centre of the cubicle."""
    return place[0] + WALK_METRES * float(np.sin(heading)), place[1] - WALK_METRES * float(np.cos(heading))


@dataclass
class _Sight:
    """Visibility of a spot in T views."""

    spot: _Spot
    lines: Array
    """[T, 2] unit vectors to the camera."""
    length: Array
    """[T] metres to the camera."""
    in_view: NDArray[np.bool_]
    """[T] whether the spot is in the picture and not hidden by its own column."""
    states: tuple[NDArray[np.bool_], NDArray[np.bool_]]
    """[T] masks of the views before and after the change."""

    @classmethod
    def of(cls, spot: _Spot, time: tuple[float, float], seconds: Array, views: Array) -> _Sight:
        """The visibility of a spot whose change takes `time`, in views [T] at seconds [T]."""
        offset = _eyes(views) - spot.middle
        length = np.linalg.norm(offset, axis=1)
        point = np.array([*spot.middle, 1.2])
        in_view = np.array([share_in_view(views[i : i + 1], point) > 0.5 for i in range(len(views))])
        sight = cls(spot, offset / length[:, None], length, in_view, (seconds < time[0], seconds > time[1]))
        if spot.column is not None:
            sight.in_view &= sight._is_open([spot.column])
        return sight

    def _is_open(self, discs: list[Array]) -> NDArray[np.bool_]:
        """[T] whether no disc (x, y, radius) hides the spot."""
        is_open, width = np.ones(len(self.length), bool), HEAD_RADIUS if self.spot.column is not None else ARM_RADIUS
        for x, y, radius in discs:
            to = np.array([x, y]) - self.spot.middle
            along, distance = self.lines @ to, np.abs(self.lines[:, 0] * to[1] - self.lines[:, 1] * to[0])
            is_open &= (along < 0.0) | (along > self.length) | (distance > radius + width * (1.0 - along / self.length))
        return is_open

    def shown(self, neighbours: list[_Sight]) -> float:
        """Share of the views that see the spot past other spots, in the less visible state; reduced with distance."""
        shown = self.in_view & self._is_open([disc for neighbour in neighbours for disc in neighbour.spot.solid])
        return float(min(shown[state].mean() for state in self.states)) - 0.04 * float(self.length.mean())


def _layout(choices: list[list[_Sight]], rng: np.random.Generator) -> list[_Sight]:
    """One spot per role: the best of several random layouts, each improved role by role. ValueError if none fits."""
    best, found = -np.inf, None
    for _ in range(LAYOUTS):
        layout = [sights[int(rng.integers(len(sights)))] for sights in choices]
        for role in [*range(len(choices))] * 2:
            scores = [_worth([*layout[:role], sight, *layout[role + 1 :]]) for sight in choices[role]]
            layout[role] = choices[role][int(np.argmax(scores))]
        if _worth(layout) > best:
            best, found = _worth(layout), layout
    if found is None:
        raise ValueError("no layout of held things fits this seed")
    return found


def _worth(layout: list[_Sight]) -> float:
    """Score of a layout's visibility, mainly of the least visible role; -inf if two spots overlap."""
    for a, b in itertools.combinations(layout, 2):
        for one, second in itertools.product(a.spot.solid, b.spot.solid):
            if np.hypot(*(one[:2] - second[:2])) < one[2] + second[2] + 0.15:
                return -np.inf
    shares = [sight.shown([second for second in layout if second is not sight]) for sight in layout]
    return min(shares) + 0.3 * float(np.mean(shares))


def _eyes(views: Array) -> Array:
    """[T, 2] x, y positions of the cameras [T, 4, 4]."""
    return -np.einsum("tji,tj->ti", views[:, :3, :3], views[:, :3, 3])[:, :2]


def _person(seed: int, number: int, role: str, spot: _Spot, time: tuple[float, float]) -> Person:
    """An adult who holds still except for the change of the role."""
    from .people import Person

    rng = stream(seed, "held", role)
    phenotype = {
        "gender": float(rng.uniform()),
        "age": float(rng.choice([rng.uniform(0.62, 0.75), rng.uniform(0.85, 0.95)])),
        "muscle": float(rng.uniform(0.35, 0.7)),
        "weight": float(rng.uniform(0.3, 0.7)),
        "height": float(rng.uniform(0.4, 0.6)),
        "proportions": float(rng.uniform(0.4, 0.8)),
    }
    place = (float(spot.place[0]), float(spot.place[1]))
    person = Person(f"person{number}", phenotype, "stand", place, float(spot.heading), RESTLESS)
    return replace(person, changes=_changes(role, time, rng))


def _changes(role: str, time: tuple[float, float], rng: np.random.Generator) -> tuple[tuple[float, float, Pose], ...]:
    """(begin, end, pose after it) in seconds; the initial pose is reached before the clip begins."""
    before, (begin, end) = (-2.0, -1.0), time
    half = 0.5 * (begin + end)
    if role == RAISED:
        return ((begin, end, _ARM_UP[int(rng.integers(len(_ARM_UP)))]),)
    if role == TURNED:
        sign = float(rng.choice([-1.0, 1.0]))
        first, last = ({b: (0.0, 0.0, s * v[2]) for b, v in _HEAD_TURN.items()} for s in (-sign, sign))
        return (*before, first), (begin, end, last)
    if role == RESTING:
        return (*before, _HAND_ON_TABLE), (begin, end, _HAND_UP)
    if role == SET_DOWN:
        return (*before, _HOLDS), (begin, half, _OVER_TABLE), (half, end, _ARM_DOWN)
    steps = np.linspace(begin, end, 5)
    poses = (_STRIDE, _MIRRORED_STRIDE, _STRIDE, _LEGS_DOWN)
    return tuple((float(a), float(b), pose) for (a, b), pose in zip(itertools.pairwise(steps), poses, strict=True))


# ------------------------------------------------------------------------------------------------- what they do


Extra = tuple[str, Array, Mesh]
"""Name, vertices [T, V, 3] and mesh of a mover beside a person; its picture is textures/<name>.png."""


def perform(
    folder: Path, part: Part, bodies: Bodies, body: Body, furnisher: Furnisher, seed: int, seconds: Array
) -> list[Extra]:
    """Moves the body, adds the props of a role, and sets the triangles of the held thing.

    `seconds` [T]; for a walking person `body.vertices` changes in place. Writes the pictures of extras.
    """
    name, role = part.person.name, part.role
    part.movers = [name]
    faces = np.ones(len(body.triangles), bool)
    extras: list[Extra] = []
    if role == LEAVING:
        share = smooth_step(seconds, part.begin, part.end)[:, None, None]
        to = np.subtract(_walks_to(part.person.place, part.person.heading), part.person.place)
        body.vertices += (share * np.array([*to, 0.0])).astype(np.float32)
    elif role == TURNED:
        faces = _faces(bodies.influence["head"] + bodies.influence["eyes"], body)
    else:
        faces = _faces(bodies.influence["right_arm"], body)
    if role == RESTING:
        hand = body.vertices[_index(seconds, part.begin - 0.1), bodies.influence["right_hand"] > 0.9]
        _table(furnisher, part.person, hand.astype(np.float64), float(hand[:, 2].min()) + 0.004)
    if role == RAISED and seed % 2 == 0:
        extras.append(_panel(folder, part, body, faces, seed, seconds))
    if role == SET_DOWN:
        extras.append(_set_down(folder, part, bodies, body, furnisher, seed, seconds))
        part.movers.append(extras[0][0])
        part.objects = [SceneObject(role, extras[0][0], every := np.ones(len(extras[0][2].triangles), bool), every)]
    else:
        part.objects = [SceneObject(role, name, faces, faces)]
    return extras


def _index(seconds: Array, at: float) -> int:
    """Index of the frame nearest to a time."""
    return int(np.abs(seconds - at).argmin())


def _faces(influence: Array, body: Body) -> NDArray[np.bool_]:
    """[F] triangles that mostly follow the given bones."""
    return influence[body.triangles].mean(axis=1) > 0.5


def _table(furnisher: Furnisher, person: Person, above: Array, height: float) -> None:
    """Adds a round table with its top at `height` below points [P, 3], offset away from the person."""
    forward = np.array([np.sin(person.heading), -np.cos(person.heading)])
    x, y = above[:, :2].mean(axis=0) + 0.08 * forward
    wood = furnisher.material("planks")
    furnisher.build.cylinder([x, y, 0.0], 0.18, 0.03, wood)
    furnisher.build.cylinder([x, y, 0.03], 0.03, height - 0.06, wood, 12)
    furnisher.build.cylinder([x, y, height - 0.03], 0.22, 0.03, wood)
    # The underside, which a cylinder lacks.
    furnisher.build.cylinder([x, y, height - 0.03], 0.22, 0.0, wood)


def _panel(folder: Path, part: Part, body: Body, faces: NDArray[np.bool_], seed: int, seconds: Array) -> Extra:
    """A panel behind the arm, with the arm's colours in patches of the arm's size."""
    rng = stream(seed, "held", "panel")
    a, b, c = (body.vertices[0, body.triangles[faces, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    # Sample by area, because a hand has as many triangles as the rest of the arm.
    uv = body.uv[faces].mean(axis=1)[rng.choice(len(area), 4096, p=area / area.sum())]
    size = len(body.texture)
    row, column = (np.clip((v * size).astype(int), 0, size - 1) for v in (1.0 - uv[:, 1], uv[:, 0]))
    tones = body.texture[row, column].astype(np.float64)
    tones = tones[np.argsort(tones.sum(axis=1))]
    pattern = fractal(rng, 128, 1.3)
    rank = pattern.ravel().argsort().argsort().reshape(pattern.shape) / pattern.size
    picture = tones[(rank * len(tones)).astype(int)]
    write_png(folder / "textures" / "panel.png", np.round(picture).astype(np.uint8))
    heading = part.person.heading
    back = np.array([-np.sin(heading), np.cos(heading)])
    builder = Builder([1.0])
    at = np.asarray(part.person.place) + PANEL_BEHIND * back
    builder.box([*at, PANEL_SIZE[2] / 2], PANEL_SIZE, 0, heading)
    mesh = builder.mesh()
    return "panel", np.tile(mesh.vertices.astype(np.float64), (len(seconds), 1, 1)), mesh


def _set_down(
    folder: Path, part: Part, bodies: Bodies, body: Body, furnisher: Furnisher, seed: int, seconds: Array
) -> Extra:
    """A box that follows the hand until the middle of the change and then stands on a table."""
    from .textures import TEXTURES

    heading = part.person.heading
    forward = np.array([np.sin(heading), -np.cos(heading), 0.0])
    hands = body.vertices[:, bodies.influence["right_hand"] > 0.9].mean(axis=1).astype(np.float64)
    half = 0.5 * (part.begin + part.end)
    down = hands[_index(seconds, half)]
    progress = smooth_step(seconds, half - 0.05, half + 0.05)[:, None]
    at = (1.0 - progress) * hands + progress * down + 0.1 * forward
    builder = Builder([0.0])
    builder.box([0.0, 0.0, 0.0], BOX_SIZE, 0, heading)
    mesh = builder.mesh()
    write_png(folder / "textures" / "box.png", TEXTURES["poster"].draw(stream(seed, "held", "box"), 256))
    vertices = mesh.vertices[None] + at[:, None]
    _table(furnisher, part.person, at[-1:], float(at[-1, 2] - 0.5 * BOX_SIZE[2]) - 0.002)
    return "box", vertices, mesh
