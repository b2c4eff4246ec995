"""Makes the example .blend from a frozen shot: solved camera, plate, points, and the freeze in the compositor.

    python3 splannequin.py demo
    blender --background --factory-startup --python examples/make_example.py
    .venv-bpy-4.2/bin/python examples/make_example.py -- --shot my_shot.splannequin --output my_example.blend

The file names its pictures relative to itself and holds none, so it stays small, and shows them as long as the shot's
folder lies where it did, seen from the file. Made in Blender 4.2, it opens in every later version.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
NOTE = """Splannequin: {shot}, frozen at frame {t_star}

Camera: press Numpad 0, play. The plate is behind the camera, the solve's points are around it.
Compositor: "Splannequin Freeze" stands before the output. Mix 0 is the plate, 1 the frozen frame.
Render > Render Animation writes the frames {first} to {last} to {output}.

Pink or black pictures: the frames are not in the repository. They are made by
    python3 splannequin.py demo
which leaves them in output/demo/shot.splannequin, where this file looks for them.

examples/README.md has the clip's licence and credit, docs/manual/ the manual.
"""


def main() -> int:
    """Reads the arguments after `--` (under bpy: all), makes the file; returns an exit code."""
    arguments = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    if "--background" in sys.argv and "--" not in sys.argv:
        arguments = []  # they are Blender's own
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--shot", default=str(ROOT / "output" / "demo" / "shot.splannequin"), help="a frozen shot")
    parser.add_argument("--take", default="freeze", help="name of its take")
    parser.add_argument("--output", default=str(ROOT / "examples" / "sitting_frozen.blend"), help="the .blend")
    args = parser.parse_args(arguments)
    package = _package()
    package.register()
    try:
        make(Path(args.shot), args.take, Path(args.output))
    except (OSError, ValueError) as error:
        print(f"Error: {error}. `python3 splannequin.py demo` makes the shot.", file=sys.stderr)
        return 2
    except Exception as error:
        if type(error).__name__ != "JobError":
            raise
        print(f"Error: {getattr(error, 'message', error)} {getattr(error, 'hint', '')}".rstrip(), file=sys.stderr)
        return 2
    finally:
        package.unregister()
    print(f"{args.output}: {Path(args.output).stat().st_size / 1e6:.1f} MB")
    return 0


def make(shot: Path, take: str, output: Path) -> None:
    """Writes the example of a take of a shot to a .blend.

    Raises:
        OSError, ValueError: there is no such shot, or the file cannot be written.
        JobError: the take holds no frames.
    """
    import bpy

    def ours(name: str):
        return importlib.import_module(f"{_package().__name__}.splannequin_addon.{name}")

    bake, shots = ours("bake.insertion"), ours("shot.inventory")
    shot, output = shot.absolute(), output.absolute()
    state = shots.read(shot)
    if not state.solve or take not in state.takes:
        raise ValueError(f"{shot} holds no take {take!r} of a solved clip")
    bpy.ops.wm.read_homefile(use_empty=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(output), check_existing=False)  # what is relative needs a place
    scene = bpy.context.scene
    props = scene.splannequin
    props.shot_path, props.take_name, props.t_star = str(shot), take, int(state.takes[take]["t_star_frame"])
    ours("solve.arrival").load_camera(scene, shot)
    ours("bake.insertion").insert_freeze(scene, shot, take)
    bake.fit_take(scene, shot, take)
    scene.render.filepath = f"//{output.stem}_frames/{ours('bake.rendering').DIGITS}"
    first, last = state.frame_range
    note = bpy.data.texts.new("Read me")
    note.write(
        NOTE.format(shot=state.info["name"], t_star=props.t_star, first=first, last=last, output=scene.render.filepath)
    )
    note.cursor_set(0)
    ours("scene.sequences").relative_images()
    props.shot_path = ours("scene.paths").blend_path(shot)
    scene.frame_set(first)
    before = bpy.context.preferences.filepaths.save_version
    bpy.context.preferences.filepaths.save_version = 0
    try:
        bpy.ops.wm.save_as_mainfile(filepath=str(output), check_existing=False, compress=True)
    finally:
        bpy.context.preferences.filepaths.save_version = before


def _package():
    """The add-on under its name in Blender, from this repository."""
    name = "_splannequin_run_in_bpy"
    if name not in sys.modules:
        spec = importlib.util.spec_from_file_location(name, ROOT / "splannequin_addon" / "run_in_bpy.py")
        if spec is None or spec.loader is None:
            raise FileNotFoundError(f"{ROOT} holds no splannequin_addon")
        sys.modules[name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[name])
    return sys.modules[name].load_package()


if __name__ == "__main__":
    code = main()
    sys.stdout.flush()
    sys.exit(code)
