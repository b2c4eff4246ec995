"""Tests that installing, upgrading and removing the extension in a real Blender leaves the artist's data unchanged.

    python3 .ci/upgrade.py BLENDER ZIP FOLDER

It installs the last release, then ZIP over it, then removes it. FOLDER receives a Blender profile, a home folder, a
shot and a .blend. The profile has an artist's preferences, files and another extension. After each step all of them are
compared with the state before: files by SHA-256, preferences by value, because Blender rewrites userpref.blend. In
Blender this file runs one step: `-- STEP FOLDER`.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
LAST_RELEASE = "74149e5fcab7ac85a4366a387147237a435234a9"
"""Commit of 0.2.0, which was never published. The zip built from it represents the last release."""
MODULE = "bl_ext.user_default.splannequin"
BYSTANDER = "bl_ext.user_default.bystander"
OURS = ("extensions/user_default/splannequin/", "extensions/.user/user_default/splannequin/")
"""Folders of the profile that belong to the add-on."""
BLENDERS = ("config/userpref.blend", "extensions/user_default/.blender_ext/", "extensions/.cache/")
"""Files that Blender rewrites when extensions change; preferences are compared by value."""
BYSTANDER_FILES = {
    "blender_manifest.toml": """schema_version = "1.0.0"
id = "bystander"
version = "1.0.0"
name = "Bystander"
tagline = "An extension of the artist"
maintainer = "Artist"
type = "add-on"
blender_version_min = "4.2.0"
license = ["SPDX:GPL-3.0-or-later"]
""",
    "__init__.py": """import bpy
class Bystander(bpy.types.AddonPreferences):
    bl_idname = __package__
    text: bpy.props.StringProperty()
def register():
    bpy.utils.register_class(Bystander)
def unregister():
    bpy.utils.unregister_class(Bystander)
""",
}


class Harm(Exception):
    """Raised if a release does something that it must not do; the message is one sentence."""


def main(blender: str, archive: Path, folder: Path) -> int:
    """Runs all steps; returns an exit code."""
    shutil.rmtree(folder, ignore_errors=True)
    run = Runs(blender, folder)
    try:
        run.installs(bystander(run, folder), "bystander")
        run.step("prepare")
        start = run.seen()
        run.installs(last_release(run, archive, folder), "0.2.0")
        run.compare("installed 0.2.0", start, addon="0.2.0")
        run.step("work")
        work = run.seen()
        run.step("upgrade", str(archive))
        run.compare("upgraded while the shot is open", work, addon=version_of(archive))
        leftover = run.leftovers(archive)
        if leftover:
            raise Harm(f"upgraded: files of 0.2.0 are left: {', '.join(leftover)}")
        run.step("reopen")
        run.compare("opened the file in the new version", work, addon=version_of(archive))
        run.blender("--command", "extension", "remove", "user_default.splannequin")
        run.compare("removed", work, addon="")
        run.step("without")
        run.compare("opened the file without the add-on", work, addon="")
        run.same_profile(start)
    except Harm as harm:
        print(f"Error: {harm}", file=sys.stderr)
        return 1
    print("nothing of the artist's was changed")
    return 0


class Runs:
    """Runs of a Blender with a separate profile and home folder."""

    def __init__(self, program: str, folder: Path) -> None:
        self.program, self.folder = program, folder
        self.profile, self.home, self.work = folder / "profile", folder / "home", folder / "work"
        for place in (self.profile, self.home, self.work):
            place.mkdir(parents=True)

    def blender(self, *words: str) -> str:
        """Runs Blender and returns its output. Raises Harm if it fails."""
        environ = {**os.environ, "BLENDER_USER_RESOURCES": str(self.profile), "HOME": str(self.home)}
        for name in ("SPLANNEQUIN_HOME", "SPLANNEQUIN_BACKEND_PYTHON"):
            environ.pop(name, None)
        done = subprocess.run([self.program, "--background", *words], env=environ, capture_output=True, text=True)
        if done.returncode:
            raise Harm(f"Blender ended with {done.returncode}: {' '.join(words)}\n{done.stdout}{done.stderr}")
        return done.stdout

    def step(self, name: str, *words: str) -> None:
        """Runs a step of this file in Blender."""
        self.blender("--python-exit-code", "3", "--python", __file__, "--", name, str(self.folder), *words)

    def installs(self, archive: Path, what: str) -> None:
        """Installs and enables an extension as the command line does."""
        self.blender("--command", "extension", "install-file", "-r", "user_default", "-e", str(archive))
        print(f"installed {what}", flush=True)

    def seen(self) -> dict[str, Any]:
        """The state of the artist's data: files by SHA-256, preferences by value."""
        self.step("preferences")
        preferences = json.loads((self.folder / "preferences.json").read_text(encoding="utf-8"))
        files = {**files_of(self.profile, (*OURS, *BLENDERS)), **files_of(self.work, ())}
        return {"files": files, "home": files_of(self.home, (".cache/",)), "preferences": preferences}

    def compare(self, when: str, before: dict[str, Any], addon: str) -> None:
        """Raises Harm if the artist's data differ, or if the installed version of the add-on is not `addon`."""
        after = self.seen()
        for part in ("files", "home", "preferences"):
            was, now = without_addon(before[part]), without_addon(after[part])
            differs = sorted(key for key in was.keys() | now.keys() if was.get(key) != now.get(key))
            if differs:
                raise Harm(f"{when}: {part} changed: " + ", ".join(f"{k}: {was.get(k)} {now.get(k)}" for k in differs))
        enabled = MODULE in after["preferences"]["addons"]
        manifest = self.profile / OURS[0] / "blender_manifest.toml"
        found = re.search(r'^version = "(.+)"', manifest.read_text(encoding="utf-8"), re.M) if enabled else None
        if (found.group(1) if found else "") != addon or (not addon and manifest.parent.exists()):
            raise Harm(f"{when}: the add-on is not {addon or 'gone'}")
        # An upgrade must keep the artist's values in the add-on's preferences.
        ours, kept = (one["preferences"]["addons"].get(MODULE) for one in (before, after))
        lost = {key: value for key, value in (ours or {}).items() if kept is not None and kept.get(key) != value}
        if lost:
            raise Harm(f"{when}: the add-on's preferences changed: {lost}")
        print(
            f"{when}: {len(after['files'])} files and {len(after['preferences'])} preferences are the same", flush=True
        )

    def leftovers(self, archive: Path) -> list[str]:
        """Files of the installed add-on that are not in its zip."""
        with zipfile.ZipFile(archive) as packed:
            names = set(packed.namelist())
        installed = files_of(self.profile / OURS[0], ())
        return sorted(name for name in installed if name not in names and "__pycache__" not in name)

    def same_profile(self, start: dict[str, Any]) -> None:
        """Raises Harm if the profile differs from `start`, the state before the add-on was first installed."""
        end = self.seen()
        if end["preferences"] != start["preferences"]:
            raise Harm("removed: preferences differ from those before the first install")
        left = files_of(self.profile, BLENDERS).keys() - start["files"].keys()
        if left:
            raise Harm(f"removed: files are left: {', '.join(sorted(left))}")


def without_addon(state: dict[str, Any]) -> dict[str, Any]:
    """Preferences without our add-on's preferences; other states unchanged."""
    if "addons" not in state:
        return state
    return {**state, "addons": {name: values for name, values in state["addons"].items() if name != MODULE}}


def files_of(folder: Path, leave_out: tuple[str, ...]) -> dict[str, str]:
    """SHA-256 of each file below a folder by relative path, without paths that begin with an entry of `leave_out`."""
    found: dict[str, str] = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_file() and not name.startswith(leave_out) and "__pycache__" not in name:
            found[name] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


def version_of(archive: Path) -> str:
    """Version of an extension's zip."""
    with zipfile.ZipFile(archive) as packed:
        manifest = packed.read("blender_manifest.toml").decode("utf-8")
    return re.findall(r'^version = "(.+)"', manifest, re.M)[0]


def bystander(run: Runs, folder: Path) -> Path:
    """Zip of another extension, installed by the artist."""
    source = folder / "bystander"
    source.mkdir()
    for name, text in BYSTANDER_FILES.items():
        (source / name).write_text(text, encoding="utf-8")
    return built(run, source, folder / "bystander.zip")


def last_release(run: Runs, archive: Path, folder: Path) -> Path:
    """Zip of 0.2.0. In a shallow clone without that commit, the new zip with version 0.2.0 in its manifest."""
    source = folder / "last"
    command = ["git", "-C", str(ROOT), "archive", "--format=zip", "-o", str(folder / "last-source.zip"), LAST_RELEASE]
    if subprocess.run(command, capture_output=True).returncode == 0:
        with zipfile.ZipFile(folder / "last-source.zip") as packed:
            packed.extractall(source)
    else:
        print("note: the commit of 0.2.0 is not in this clone: the new zip stands for it, with its version", flush=True)
        with zipfile.ZipFile(archive) as packed:
            packed.extractall(source)
        manifest = source / "blender_manifest.toml"
        text = manifest.read_text(encoding="utf-8").replace(f'"{version_of(archive)}"', '"0.2.0"', 1)
        manifest.write_text(text, encoding="utf-8")
    return built(run, source, folder / "last.zip")


def built(run: Runs, source: Path, target: Path) -> Path:
    """Zip that Blender builds from the folder `source`."""
    run.blender("--command", "extension", "build", "--source-dir", str(source), "--output-filepath", str(target))
    return target


# The functions below run in Blender.


def in_blender(step: str, folder: Path, *words: str) -> None:
    """Runs one step. An exception makes Blender exit with an error code."""
    import bpy

    file = folder / "work" / "artist.blend"
    if step == "preferences":
        values = values_of(bpy.context.preferences)
        values["addons"] = {
            a.module: values_of(a.preferences) if a.preferences else {} for a in bpy.context.preferences.addons
        }
        (folder / "preferences.json").write_text(json.dumps(values, sort_keys=True), encoding="utf-8")
    elif step == "prepare":
        prepare(folder)
    elif step == "work":
        work(folder, file)
    else:
        bpy.ops.wm.open_mainfile(filepath=str(file))
        if step == "upgrade":
            bpy.ops.extensions.package_install_files(filepath=words[0], repo="user_default", enable_on_install=True)
        look(step, folder)


def values_of(group: Any, path: str = "") -> dict[str, Any]:
    """Values of the writable properties of a group and its nested groups, by path."""
    import bpy

    found: dict[str, Any] = {}
    for prop in group.bl_rna.properties:
        name, nested = f"{path}{prop.identifier}", prop.type in ("POINTER", "COLLECTION")
        if prop.identifier in ("rna_type", "addons", "is_dirty", "bl_idname") or (prop.is_readonly and not nested):
            continue
        value = getattr(group, prop.identifier)
        if prop.type == "COLLECTION":
            for number, one in enumerate(value):
                found.update(values_of(one, f"{name}[{number}]."))
        elif prop.type == "POINTER":
            found.update(values_of(value, f"{name}.") if isinstance(value, bpy.types.bpy_struct) else {})
        elif isinstance(value, set):
            found[name] = repr(sorted(value))
        else:
            found[name] = repr(list(value) if getattr(prop, "is_array", False) else value)
    return found


def prepare(folder: Path) -> None:
    """Creates an artist's preferences, startup file and presets."""
    import bpy

    preferences = bpy.context.preferences
    preferences.edit.undo_steps = 77
    preferences.view.show_tooltips_python = True
    preferences.filepaths.render_output_directory = str(folder / "work")
    preferences.addons[BYSTANDER].preferences.text = "set by the artist"
    bpy.ops.wm.save_userpref()
    bpy.context.scene.render.resolution_x = 1234
    bpy.ops.wm.save_homefile()
    scripts = Path(bpy.utils.user_resource("SCRIPTS", path="presets/render", create=True))
    (scripts / "mine.py").write_text("# a preset of the artist's\n", encoding="utf-8")


def work(folder: Path, file: Path) -> None:
    """Creates and saves a scene with an artist's object and a shot, in the last release."""
    import bpy

    spec = importlib.util.spec_from_file_location("make_shot", ROOT / "tests" / "addon" / "data" / "make_shot.py")
    assert spec and spec.loader
    make_shot = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(make_shot)
    shot = make_shot.make_shot(folder / "work")
    scene = bpy.context.scene
    bpy.ops.mesh.primitive_monkey_add()
    bpy.context.object.name = "The artist's"
    scene.splannequin.shot_path, scene.splannequin.t_star = str(shot), 6
    scene.splannequin.choose_t_star, scene.splannequin.run_name = True, "main"
    assert bpy.ops.splannequin.load_camera() == {"FINISHED"}
    bpy.context.preferences.addons[MODULE].preferences.backend_python = "/opt/my/python"
    bpy.ops.wm.save_userpref()
    bpy.ops.wm.save_as_mainfile(filepath=str(file))


def look(step: str, folder: Path) -> None:
    """Checks the contents of the opened file, with the new version or without the add-on."""
    import bpy

    scene, names = bpy.context.scene, set(bpy.data.objects.keys())
    assert "The artist's" in names and scene.camera is not None, names
    assert scene.camera.matrix_world != scene.camera.matrix_world.Identity(4)
    if step == "without":
        assert not hasattr(scene, "splannequin")
        return
    settings = scene.splannequin
    assert (settings.t_star, settings.choose_t_star, settings.run_name) == (6, True, "main")
    shot = Path(bpy.path.abspath(settings.shot_path))
    assert shot.resolve() == next((folder / "work").glob("*.splannequin")).resolve()
    state = sys.modules[f"{MODULE}.splannequin_addon.shot.inventory"].read(shot)
    assert state.runs and state.takes, state


if __name__ == "__main__":
    if "--" in sys.argv:
        name, place, *words = sys.argv[sys.argv.index("--") + 1 :]
        in_blender(name, Path(place), *words)
    else:
        sys.exit(main(sys.argv[1], Path(sys.argv[2]).absolute(), Path(sys.argv[3]).absolute()))
