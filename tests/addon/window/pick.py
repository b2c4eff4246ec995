"""Clicks points of a solve in a real Blender window: origin, floor and scale, Esc, Backspace, undo.

    python tests/addon/window/pick.py --blender BLENDER --shot SHOT.splannequin [--output docs/images]

BLENDER has the extension installed, as for press_steps.py. Prints the checks as JSON. Takes pictures of a point under
the mouse, of two of three picked points, and of the dialog for the distance.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

import press_steps as press


class _Artist:
    """Simulates the mouse over the first 3D view."""

    def __init__(self, scene: Any) -> None:
        import bpy

        self.window = bpy.context.window_manager.windows[0]
        self.area = press._view(self.window)
        self.region = next(r for r in self.area.regions if r.type == "WINDOW")
        self.scene = scene

    @property
    def root(self) -> Any:
        return self.scene.splannequin.made[0].root

    def at(self, place: Any) -> tuple[int, int]:
        """Pixel of a point in world space."""
        from bpy_extras.view3d_utils import location_3d_to_region_2d

        seen = location_3d_to_region_2d(self.region, self.region.data, place)
        return self.region.x + round(seen.x), self.region.y + round(seen.y)

    def invoke(self, operator: str) -> None:
        """Invoke an operator as a button of the sidebar does."""
        import bpy

        side = press._sidebar(self.area)
        with bpy.context.temp_override(window=self.window, area=self.area, region=side):
            getattr(bpy.ops.splannequin, operator)("INVOKE_DEFAULT")

    def press(self, kind: str, x: int, y: int) -> Iterator[float]:
        """Press and release a key or button."""
        press._move(self.window, x - 1, y)
        yield 0.1
        press._move(self.window, x, y)
        yield 0.2
        self.window.event_simulate(type=kind, value="PRESS", x=x, y=y)
        self.window.event_simulate(type=kind, value="RELEASE", x=x, y=y)
        yield 0.4

    def points(self) -> list[Any]:
        """Four points of the solve that are isolated in the view, as world positions."""
        cloud = self.scene.splannequin.made[0].points
        side, chosen = press._sidebar(self.area), []
        seen = [(v.co.copy(), cloud.matrix_world @ v.co) for v in cloud.data.vertices]
        pixels = [self.at(p) if _is_in_front(self.region, p) else (-9, -9) for _, p in seen]
        for (local, _), (x, y) in zip(seen, pixels, strict=True):
            inside = self.region.x + 120 < x < side.x - 60 and self.region.y + 90 < y < self.region.y + 500
            is_isolated = inside and sum(abs(a - x) < 5 and abs(b - y) < 5 for a, b in pixels) == 1
            if is_isolated and all(abs(self.at(cloud.matrix_world @ c)[0] - x) > 60 for c in chosen):
                chosen.append(local)
        return chosen[:4]


def _is_in_front(region: Any, place: Any) -> bool:
    return (region.data.perspective_matrix @ place.to_4d()).w > 0.01


def _play(plan: dict[str, Any], results: dict[str, Any]) -> Iterator[float]:
    import bpy

    work = Path(plan["work"])
    yield from press._arrange()
    scene = bpy.context.scene
    scene.splannequin.shot_path = plan["shot"]
    artist = _Artist(scene)
    with bpy.context.temp_override(window=artist.window):
        bpy.ops.splannequin.load_camera()
    yield 1.5
    picks = artist.points()
    results["points"] = len(picks)
    cloud = scene.splannequin.made[0].points

    def world(n: int) -> Any:
        return scene.splannequin.made[0].points.matrix_world @ picks[n]

    def free() -> bool:
        return press.addon_module("solve.align_operators").picking() is None

    stood = cloud.matrix_world.copy()
    artist.invoke("align_origin")
    yield 0.3
    x, y = artist.at(world(0))
    press._move(artist.window, x + 4, y + 3)
    yield 0.5
    yield from press._shoot(work, "10-point-under-the-mouse")
    yield from artist.press("ESC", x, y)
    results["escape_changes_nothing"] = free() and scene.splannequin.made[0].points.matrix_world == stood
    artist.invoke("align_origin")
    yield 0.3
    yield from artist.press("LEFTMOUSE", *artist.at(world(0)))
    results["origin"] = free() and world(0).length < 1e-4
    artist.invoke("align_floor")
    yield 0.3
    for n in (1, 2, 3):
        yield from artist.press("LEFTMOUSE", *artist.at(world(n)))
        if n == 2:
            yield from artist.press("BACK_SPACE", *artist.at(world(n)))
            results["backspace"] = len(press.addon_module("solve.align_operators").picking().picked) == 1
            yield from artist.press("LEFTMOUSE", *artist.at(world(n)))
            yield from press._shoot(work, "10-two-of-three")
    results["floor"] = free() and max(abs(world(n).z) for n in (1, 2, 3)) < 1e-4
    with bpy.context.temp_override(window=artist.window):
        bpy.ops.ed.undo()
    yield 0.5
    scene = artist.scene = bpy.context.window_manager.windows[0].scene
    results["undo_takes_the_floor_back_alone"] = (
        world(0).length < 1e-4 and max(abs(world(n).z) for n in (1, 2, 3)) > 1e-3
    )
    artist.invoke("align_scale")
    yield 0.3
    for n in (1, 2):
        yield from artist.press("LEFTMOUSE", *artist.at(world(n)))
    yield 1.0
    yield from press._shoot(work, "10-distance")
    artist.window.event_simulate(type="RET", value="PRESS", x=x, y=y)
    artist.window.event_simulate(type="RET", value="RELEASE", x=x, y=y)
    yield 0.5
    results["last_operator"] = [o.bl_idname for o in bpy.context.window_manager.operators][-1:]
    results["scale"] = list(scene.splannequin.made[0].root.scale)
    failed = [name for name, value in results.items() if value is False]
    if failed:
        raise RuntimeError(f"not as it should be: {', '.join(failed)}")


if __name__ == "__main__":
    status = press.on_a_shot(__file__, __doc__ or "", _play, "solved shot folder", ":96")
    if "bpy" not in sys.modules:
        sys.exit(status)
