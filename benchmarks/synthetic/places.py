"""Places of scenes: rooms with furniture, and open ground with trees and walls. Metres, z up, floor at 0."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .geometry import Builder, Mesh
from .noise import Array, stream
from .panes import GLASS, MIRROR, Pane
from .textures import TEXTURES

WINDOW_WIDTH, WINDOW_LOW, WINDOW_HIGH = 2.2, 0.85, 2.25
"""Width of a window, and heights of its lower and upper edges above the floor, in metres."""
MIRROR_SIZE, MIRROR_LOW = (1.1, 1.5), 0.65
"""Width and height of a mirror, and height of its lower edge above the floor, in metres."""
MAX_VARIANTS = 10
"""Most pictures of one texture in a scene; further uses repeat them."""
ROOM_SKIES = ("courtyard", "city", "forest")
OPEN_SKIES = ("courtyard", "forest", "city", "sunrise")


@dataclass
class Material:
    """A texture on a surface."""

    texture: str
    """Name in TEXTURES."""
    variant: int
    """Seed of the picture within the scene."""
    emission: float = 0.0
    """Radiance of a lamp's shade; 0 for surfaces that only reflect."""

    @property
    def file(self) -> str:
        return f"{self.texture}-{self.variant}.png"


@dataclass
class Keepout:
    """A disc of ground to keep free."""

    x: float
    y: float
    radius: float


@dataclass(frozen=True)
class FrontWall:
    """Contents of the wall that the camera faces; x in metres, 0 at its centre."""

    window_x: float
    """Centre of the window. The other walls then have none."""
    window_width: float = WINDOW_WIDTH
    mirror_x: float | None = None
    """Centre of a mirror; None for no mirror."""
    glazed: bool = False
    """True if the window has a reflecting pane."""
    garden: bool = False
    """True for a garden outside, False for sky only."""
    sky_strength: float = 1.6


@dataclass
class Place:
    """The static part of a scene, without people."""

    materials: list[Material] = field(default_factory=list)
    lights: list[dict[str, Any]] = field(default_factory=list)
    """Lights in the format of render_bpy.py."""
    sky: str = "courtyard"
    """Name of a CC0 world from Blender's studio lights."""
    sky_strength: float = 1.0
    sky_turn: float = 0.0
    """Rotation of the sky about z in radians."""
    panes: list[Pane] = field(default_factory=list)
    """Glass and mirrors, which are not in the mesh."""


class Furnisher:
    """Adds furniture to a place, away from the camera's path and people."""

    def __init__(self, seed: int, path: Array, people: list[Keepout], front_wall: FrontWall | None = None) -> None:
        self.seed = seed
        self.front_wall = front_wall
        self.rng = stream(seed, "furniture")
        self.path = path
        self.occupied = list(people)
        self.place = Place()
        self.scales: list[float] = []
        self.build = Builder(self.scales)

    def material(self, texture: str, fresh: bool = True, emission: float = 0.0) -> int:
        """Index of a material of this texture: a new variant, or an existing one."""
        same = [i for i, m in enumerate(self.place.materials) if m.texture == texture and m.emission == emission]
        if same and (not fresh or len(same) >= MAX_VARIANTS):
            return same[int(self.rng.integers(len(same)))]
        self.place.materials.append(Material(texture, len(same), emission))
        self.scales.append(TEXTURES[texture].metres)
        return len(self.scales) - 1

    def free(self, x: float, y: float, radius: float, from_path: float = 0.55) -> bool:
        """Reserves a disc; True if it was free and far enough from the path."""
        if np.hypot(self.path[:, 0] - x, self.path[:, 1] - y).min() < radius + from_path:
            return False
        if any(np.hypot(t.x - x, t.y - y) < t.radius + radius for t in self.occupied):
            return False
        self.occupied.append(Keepout(x, y, radius))
        return True

    # ------------------------------------------------------------------------------------------------- furniture

    def shelf(self, x: float, y: float, yaw: float, width: float) -> None:
        """Adds an open shelf with rows of books, its front towards local -y."""
        wood, books = self.material("planks"), [self.material("books") for _ in range(2)]
        c, s = np.cos(yaw), np.sin(yaw)

        def at(dx: float, dy: float, z: float) -> list[float]:
            return [x + c * dx - s * dy, y + s * dx + c * dy, z]

        height, boards = float(self.rng.uniform(1.7, 2.1)), 5
        self.build.box(at(0, 0.15, height / 2), [width, 0.04, height], wood, yaw)
        for side in (-1, 1):
            self.build.box(at(side * width / 2, 0, height / 2), [0.04, 0.34, height], wood, yaw)
        for i in range(boards + 1):
            self.build.box(at(0, 0, 0.02 + i * (height - 0.04) / boards), [width, 0.34, 0.035], wood, yaw)
        for i in range(boards):
            low, room = 0.04 + i * (height - 0.04) / boards, (height - 0.04) / boards - 0.04
            if self.rng.uniform() < 0.8:
                start, filled = -width / 2 + 0.03, float(self.rng.uniform(0.55, 0.95)) * (width - 0.06)
                row = [filled, 0.2, room * 0.92]
                self.build.box(at(start + filled / 2, 0.02, low + row[2] / 2), row, wood, yaw, books[i % 2])
            else:
                for dx in (-0.3, 0.0, 0.3):
                    radius = float(self.rng.uniform(0.06, 0.11))
                    self.build.ball(at(dx * width, 0, low + radius), [radius] * 3, self.material("fabric", False))

    def table(self, x: float, y: float, yaw: float) -> None:
        """Adds a table with four legs and objects on it."""
        wood = self.material("planks")
        width, depth, height = self.rng.uniform(1.0, 1.5), self.rng.uniform(0.6, 0.8), self.rng.uniform(0.5, 0.76)
        c, s = np.cos(yaw), np.sin(yaw)
        self.build.box([x, y, height - 0.02], [width, depth, 0.04], wood, yaw)
        for i in (-1, 1):
            for j in (-1, 1):
                dx, dy = i * (width / 2 - 0.06), j * (depth / 2 - 0.06)
                self.build.box(
                    [x + c * dx - s * dy, y + s * dx + c * dy, (height - 0.04) / 2],
                    [0.06, 0.06, height - 0.04],
                    wood,
                    yaw,
                )
        for dx in np.linspace(-0.4, 0.4, 4) * width:
            px, py, kind = x + c * dx, y + s * dx, int(self.rng.integers(4))
            if kind == 0:
                size = self.rng.uniform(0.1, 0.22, 3)
                self.build.box(
                    [px, py, height + size[2] / 2], size, self.material("cardboard"), float(self.rng.uniform(0, 3))
                )
            elif kind == 1:
                self.build.cylinder(
                    [px, py, height], 0.05, float(self.rng.uniform(0.12, 0.3)), self.material("fabric"), 16
                )
            elif kind == 2:
                radius = float(self.rng.uniform(0.06, 0.1))
                self.build.ball([px, py, height + radius], [radius] * 3, self.material("fabric"))
            else:
                self.build.box(
                    [px, py, height + 0.03], [0.2, 0.28, 0.06], self.material("poster"), float(self.rng.uniform(0, 3))
                )

    def sofa(self, x: float, y: float, yaw: float) -> None:
        """Adds a sofa with back, arms and two cushions; it faces local -y."""
        cloth, cushions = self.material("fabric"), self.material("fabric")
        c, s = np.cos(yaw), np.sin(yaw)
        parts = [
            ((0, 0, 0.22), (1.8, 0.8, 0.36), cloth),
            ((0, 0.34, 0.6), (1.8, 0.18, 0.5), cloth),
            ((-0.95, 0, 0.34), (0.16, 0.8, 0.6), cloth),
            ((0.95, 0, 0.34), (0.16, 0.8, 0.6), cloth),
            ((-0.5, 0.18, 0.56), (0.45, 0.16, 0.36), cushions),
            ((0.52, 0.18, 0.56), (0.45, 0.16, 0.36), cushions),
        ]
        for (dx, dy, z), size, material in parts:
            self.build.box([x + c * dx - s * dy, y + s * dx + c * dy, z], size, material, yaw)

    def stool(self, x: float, y: float, height: float, yaw: float) -> None:
        """Adds a seat for a person."""
        self.build.box([x, y, height / 2], [0.42, 0.42, height], self.material("fabric"), yaw)

    def boxes(self, x: float, y: float) -> None:
        """Adds a stack of cartons."""
        z = 0.0
        for _ in range(int(self.rng.integers(2, 4))):
            size = self.rng.uniform(0.3, 0.5, 3)
            self.build.box([x, y, z + size[2] / 2], size, self.material("cardboard"), float(self.rng.uniform(0, 1.5)))
            z += size[2]

    def plant(self, x: float, y: float, height: float) -> None:
        """Adds a potted plant with balls of leaves."""
        self.build.cylinder([x, y, 0.0], 0.2, 0.35, self.material("tiles", False))
        leaves = self.material("leaves", False)
        self.build.cylinder([x, y, 0.3], 0.03, height - 0.4, self.material("bark", False), 10)
        for _ in range(9):
            r = float(self.rng.uniform(0.1, 0.22))
            at = [x + self.rng.normal(0, 0.16), y + self.rng.normal(0, 0.16), self.rng.uniform(0.6, 1.0) * height]
            self.build.ball(at, [r, r, 0.7 * r], leaves, 10, 6)

    def lamp(self, x: float, y: float) -> None:
        """Adds a floor lamp."""
        self.build.cylinder([x, y, 0.0], 0.16, 0.03, self.material("concrete", False))
        self.build.cylinder([x, y, 0.03], 0.015, 1.45, self.material("concrete", False), 10)
        self.build.cylinder([x, y, 1.4], 0.2, 0.28, self.material("fabric"), 20)

    def posters(
        self, origin: Array, along: Array, length: float, spots: int, occupied: list[tuple[float, float]]
    ) -> None:
        """Adds framed pictures on a wall from `origin` along the unit vector `along`, outside the spans `occupied`."""
        normal = np.array([along[1], -along[0], 0.0])
        for _ in range(4 * spots):
            if spots == 0:
                return
            width, height = self.rng.uniform(0.5, 1.1), self.rng.uniform(0.5, 1.0)
            start, z = self.rng.uniform(0.2, length - width - 0.2), self.rng.uniform(1.15, 1.55)
            if any(start < b + 0.1 and start + width > a - 0.1 for a, b in occupied):
                continue
            occupied.append((start, start + width))
            spots -= 1
            corner = origin + along * start + normal * 0.025 + [0, 0, z]
            self.build.rect(corner, along * width, [0, 0, height], self.material("poster"))
            yaw = float(np.arctan2(along[1], along[0]))
            middle = origin + along * (start + width / 2) + normal * 0.011 + [0, 0, z + height / 2]
            self.build.box(middle, [width + 0.06, 0.022, height + 0.06], self.material("planks", False), yaw)

    def wall(
        self, origin: Array, along: Array, length: float, height: float, window: tuple[float, float] | None
    ) -> None:
        """Adds a wall facing the room (`along` × z points into it), with a window from `window[0]` to `window[1]`."""
        texture = ("plaster", "wallpaper", "bricks", "plaster", "concrete")[self.rng.integers(5)]
        skin, board = self.material(texture), self.material("planks", False)
        up = np.array([0.0, 0.0, 1.0])
        spans = [(0.0, length, 0.0, height)]
        if window:
            a, b = window
            low, high = WINDOW_LOW, WINDOW_HIGH
            spans = [(0.0, a, 0.0, height), (b, length, 0.0, height), (a, b, 0.0, low), (a, b, high, height)]
            normal = np.array([along[1], -along[0], 0.0])
            yaw = float(np.arctan2(along[1], along[0]))
            for start, z, size in (
                (0.5 * (a + b), low, [b - a + 0.2, 0.3, 0.05]),
                (0.5 * (a + b), high, [b - a + 0.2, 0.12, 0.06]),
                (a, 0.5 * (low + high), [0.06, 0.12, high - low]),
                (b, 0.5 * (low + high), [0.06, 0.12, high - low]),
                (0.5 * (a + b), 0.5 * (low + high), [0.05, 0.06, high - low]),
            ):
                self.build.box(origin + along * start + normal * 0.02 + up * z, size, board, yaw)
        for start, end, low, high in spans:
            self.build.rect(origin + along * start + up * low, along * (end - start), up * (high - low), skin)
        skirting = origin + along * (length / 2) + up * 0.05
        self.build.box(skirting, [length, 0.04, 0.1], board, float(np.arctan2(along[1], along[0])))

    # ------------------------------------------------------------------------------------------------- places

    def room(self) -> tuple[Place, Mesh]:
        """Builds a furnished room with ceiling lamps and a window."""
        rng, place = self.rng, self.place
        half, front, back, height = rng.uniform(3.6, 4.3), -5.2, rng.uniform(3.4, 4.2), rng.uniform(2.7, 3.1)
        depth = back - front
        floor = self.material(("planks", "tiles", "planks", "concrete")[rng.integers(4)])
        self.build.rect([-half, front, 0], [2 * half, 0, 0], [0, depth, 0], floor)
        self.build.rect([-half, back, height], [2 * half, 0, 0], [0, -depth, 0], self.material("plaster"))
        window_wall = int(rng.integers(3))
        if self.front_wall:
            window_wall = 0
        walls = [
            (np.array([-half, back, 0.0]), np.array([1.0, 0.0, 0.0]), 2 * half),
            (np.array([half, back, 0.0]), np.array([0.0, -1.0, 0.0]), depth),
            (np.array([-half, front, 0.0]), np.array([0.0, 1.0, 0.0]), depth),
            (np.array([half, front, 0.0]), np.array([-1.0, 0.0, 0.0]), 2 * half),
        ]
        for index, (origin, along, length) in enumerate(walls):
            window = None
            if index == window_wall:
                middle = length * (0.5 if index == 0 else 0.35 if index == 1 else 0.65)
                middle += self.front_wall.window_x if self.front_wall else 0.0
                width = self.front_wall.window_width if self.front_wall else WINDOW_WIDTH
                window = (middle - width / 2, middle + width / 2)
                inward = np.array([along[1], -along[0], 0.0])
                centre = origin + along * middle - inward * 0.05 + [0, 0, 1.55]
                place.lights.append(_portal(centre, inward, width, 1.4))
            self.wall(origin, along, length, height, window)
            occupied = [window] if window else []
            if self.front_wall and index == 0:
                occupied += self._panes(self.front_wall, origin, half)
            self.posters(origin, along, length, 4 if index < 3 else 2, occupied)
        for x, y in ((-0.45 * half, -2.2), (0.45 * half, -2.2), (-0.45 * half, 1.6), (0.45 * half, 1.6)):
            place.lights.append(_panel([x, y, height - 0.06], 1.3, 0.5, 75.0))
            self.build.box([x, y, height - 0.025], [1.36, 0.56, 0.05], self.material("plaster", False, 6.0))
        if rng.uniform() < 0.7:
            w, d = rng.uniform(2.0, 3.0), rng.uniform(1.6, 2.4)
            self.build.rect([-w / 2, 0.2 - d / 2, 0.006], [w, 0, 0], [0, d, 0], self.material("rug"))
        if self.front_wall:
            for x in (self.front_wall.window_x, self.front_wall.mirror_x):
                self.occupied += [Keepout(x + dx, back - 0.4, 0.3) for dx in (-0.7, 0.0, 0.7)] if x is not None else []
        self._against_walls(half, back)
        self._in_the_middle(half, back, height)
        if self.front_wall and self.front_wall.garden:
            self._garden(self.front_wall.window_x, back)
        place.sky, place.sky_strength = (
            str(rng.choice(ROOM_SKIES)),
            self.front_wall.sky_strength if self.front_wall else 1.6,
        )
        place.sky_turn = float(rng.uniform(0, 2 * np.pi))
        return place, self.build.mesh()

    def _panes(self, front_wall: FrontWall, origin: Array, half: float) -> list[tuple[float, float]]:
        """Adds the mirror and the window's pane to the wall ahead; returns the spans covered by the mirror."""
        along = np.array([1.0, 0.0, 0.0])
        if front_wall.glazed:
            at = origin + along * (half + front_wall.window_x - front_wall.window_width / 2) + [0, 0, WINDOW_LOW]
            self.place.panes.append(
                Pane.of(GLASS, at, along * front_wall.window_width, [0, 0, WINDOW_HIGH - WINDOW_LOW])
            )
        if front_wall.mirror_x is None:
            return []
        width, height = MIRROR_SIZE
        start = half + front_wall.mirror_x - width / 2
        at = origin + along * start + [0, -0.025, MIRROR_LOW]
        self.place.panes.append(Pane.of(MIRROR, at, along * width, [0, 0, height]))
        board = origin + along * (start + width / 2) + [0, -0.011, MIRROR_LOW + height / 2]
        self.build.box(board, [width + 0.08, 0.022, height + 0.08], self.material("planks", False))
        return [(start, start + width)]

    def _garden(self, x: float, back: float) -> None:
        """Adds the view through a window in the wall ahead: a lawn, a house, trees."""
        self.build.rect([x - 12, back + 0.3, -0.01], [24, 0, 0], [0, 16, 0], self.material("grass"))
        self._house(x + float(self.rng.uniform(-2.5, 2.5)), back + 7.5, 0.0)
        for dx in (-2.6, 0.2, 2.8):
            self._tree(x + dx + float(self.rng.uniform(-0.4, 0.4)), back + float(self.rng.uniform(3.0, 5.5)))

    def _against_walls(self, half: float, back: float) -> None:
        rng = self.rng
        for x in (-0.62 * half, 0.0, 0.62 * half):
            kind = rng.integers(4)
            if not self.free(x, back - 0.4, 0.75):
                continue
            if kind <= 1:
                self.shelf(x, back - 0.22, 0.0, float(rng.uniform(1.2, 1.5)))
            elif kind == 2:
                self.sofa(x, back - 0.5, 0.0)
            else:
                self.table(x, back - 0.45, 0.0)
        for side in (-1.0, 1.0):
            for y in (-2.6, -0.6, 1.4, 2.8):
                x, kind = side * (half - 0.45), rng.integers(6)
                yaw = -side * np.pi / 2
                if not self.free(x, y, 0.6):
                    continue
                if kind == 0:
                    self.shelf(side * (half - 0.22), y, yaw, 1.1)
                elif kind == 1:
                    self.table(x, y, yaw)
                elif kind == 2:
                    self.boxes(x, y)
                elif kind == 3:
                    self.plant(x, y, float(rng.uniform(1.1, 1.7)))
                elif kind == 4:
                    self.lamp(x, y)
                else:
                    self.sofa(x - side * 0.1, y, yaw)

    def _in_the_middle(self, half: float, back: float, height: float) -> None:
        rng = self.rng
        placed = 0
        for _ in range(60):
            x, y = rng.uniform(-half + 0.9, half - 0.9), rng.uniform(-2.0, back - 1.2)
            kind = placed % 4
            if placed >= 5 or not self.free(x, y, (0.3, 0.8, 0.35, 0.35)[kind], 0.75):
                continue
            placed += 1
            if kind == 0:
                column = self.material(("bricks", "tiles", "concrete")[rng.integers(3)])
                self.build.cylinder([x, y, 0.0], float(rng.uniform(0.14, 0.22)), height, column)
            elif kind == 1:
                self.table(x, y, float(rng.uniform(0, np.pi)))
            elif kind == 2:
                self.boxes(x, y)
            else:
                self.plant(x, y, float(rng.uniform(0.9, 1.4)))

    def ground(self) -> tuple[Place, Mesh]:
        """Builds a paved square on grass or gravel, with trees, walls and benches around it."""
        rng, place = self.rng, self.place
        lawn = self.material(("grass", "gravel", "grass")[rng.integers(3)])
        # One quad is enough. It is large enough for a horizon, and its depths fit in 16 bits.
        self.build.rect([-40, -40, 0], [80, 0, 0], [0, 80, 0], lawn)
        self.build.rect(
            [-4.2, -5.5, 0.012], [8.4, 0, 0], [0, 9.5, 0], self.material(("pavers", "tiles", "bricks")[rng.integers(3)])
        )
        for bearing in np.linspace(-2.2, 2.2, 9) + rng.uniform(-0.12, 0.12, 9):
            radius = rng.uniform(6.5, 10.0)
            x, y = radius * np.sin(bearing), radius * np.cos(bearing)
            if not self.free(x, y, 1.2):
                continue
            kind = rng.integers(4)
            if kind <= 1:
                self._tree(x, y)
            elif kind == 2:
                self._house(x, y, -bearing)
            else:
                hedge = [rng.uniform(2.0, 3.5), 0.7, rng.uniform(1.0, 1.7)]
                self.build.box([x, y, hedge[2] / 2], hedge, self.material("leaves", False), -bearing)
        placed = 0
        for _ in range(120):
            x, y = rng.uniform(-4.2, 4.2), rng.uniform(-2.4, 5.0)
            kind = placed % 5
            if placed >= 9 or not self.free(x, y, (0.75, 0.3, 0.55, 0.4, 0.4)[kind], 0.8):
                continue
            placed += 1
            yaw = float(rng.uniform(0, np.pi))
            if kind == 0:
                wood = self.material("planks", False)
                self.build.box([x, y, 0.42], [1.4, 0.4, 0.06], wood, yaw)
                for d in (-0.55, 0.55):
                    stone = [x + d * np.cos(yaw), y + d * np.sin(yaw), 0.2]
                    self.build.box(stone, [0.12, 0.36, 0.4], self.material("concrete", False), yaw)
            elif kind == 1:
                self.build.cylinder([x, y, 0.0], 0.11, 1.0, self.material("fabric"))
            elif kind == 2:
                self.build.cylinder([x, y, 0.0], 0.45, 2.2, self.material("poster"), 32)
            elif kind == 3:
                self.boxes(x, y)
            else:
                self.plant(x, y, float(rng.uniform(0.9, 1.5)))
        place.sky, place.sky_strength = str(rng.choice(OPEN_SKIES)), 1.0
        place.sky_turn = float(rng.uniform(0, 2 * np.pi))
        place.lights.append(_sun(float(rng.uniform(-0.9, 0.9)), float(rng.uniform(0.5, 0.9)), 2.0))
        return place, self.build.mesh()

    def _tree(self, x: float, y: float) -> None:
        rng, height = self.rng, float(self.rng.uniform(2.2, 3.2))
        self.build.cylinder([x, y, 0.0], float(rng.uniform(0.14, 0.24)), height, self.material("bark", False), 14)
        leaves = self.material("leaves", False)
        for _ in range(12):
            r = float(rng.uniform(0.5, 0.95))
            at = [x + rng.normal(0, 0.75), y + rng.normal(0, 0.75), height + rng.uniform(-0.3, 1.6)]
            self.build.ball(at, [r, r, 0.8 * r], leaves, 12, 8)

    def _house(self, x: float, y: float, yaw: float) -> None:
        rng = self.rng
        size = [float(rng.uniform(2.5, 4.0)), 1.5, float(rng.uniform(2.4, 3.4))]
        skin = self.material(("bricks", "plaster", "concrete")[rng.integers(3)])
        self.build.box([x, y, size[2] / 2], size, skin, yaw)
        c, s = np.cos(yaw), np.sin(yaw)
        for dx in (-0.3 * size[0], 0.3 * size[0]):
            along = np.array([c, s, 0.0])
            corner = np.array([x + c * dx + s * 0.77, y + s * dx - c * 0.77, 0.7]) - along * 0.4
            self.build.rect(corner, along * 0.8, [0, 0, 1.2], self.material("poster"))


def _panel(centre: list[float], width: float, depth: float, watts: float) -> dict[str, Any]:
    """A ceiling lamp that shines down."""
    light = {"type": "AREA", "location": [float(v) for v in centre], "direction": [0.0, 0.0, -1.0]}
    return {**light, "size": [width, depth], "energy": watts, "color": [1.0, 0.95, 0.87], "portal": False}


def _portal(centre: Array, inward: Array, width: float, height: float) -> dict[str, Any]:
    """A light portal at a window, where Cycles samples the sky's light."""
    light = {"type": "AREA", "location": centre.tolist(), "direction": inward.tolist()}
    return {**light, "size": [width, height], "energy": 0.0, "color": [1.0, 1.0, 1.0], "portal": True}


def _sun(azimuth: float, elevation: float, strength: float) -> dict[str, Any]:
    """Sunlight from behind the camera, `azimuth` radians to the side and `elevation` radians above the horizon."""
    flat = np.cos(elevation)
    direction = [float(flat * np.sin(azimuth)), float(flat * np.cos(azimuth)), float(-np.sin(elevation))]
    light = {"type": "SUN", "location": [0.0, 0.0, 10.0], "direction": direction}
    return {**light, "size": [0.03, 0.03], "energy": strength, "color": [1.0, 0.96, 0.9], "portal": False}
