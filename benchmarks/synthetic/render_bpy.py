# pyright: reportMissingModuleSource=false, reportAttributeAccessIssue=false, reportOptionalMemberAccess=false
# pyright: reportGeneralTypeIssues=false, reportArgumentType=false
# Blender's type stubs for nodes, sockets and lights are incomplete. The add-on, which must work in five versions of
# Blender, is checked without these exceptions.
"""Renders the pictures listed in a plan.json: `python render_bpy.py SCENE_FOLDER`, inside a bpy wheel's Python.

Uses Cycles on the CPU, in one process per scene to keep its data. Needs only bpy, numpy and the standard library.
Standard output has JSON lines {"done", "total", "seconds"}. The parent holds standard input open; when it closes, this
process ends. Existing pictures are kept; each new one is written to a temporary file and renamed.
"""

from __future__ import annotations

import json
import os
import struct
import sys
import threading
import time
import zlib
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix, Vector

METER_GREY = 0.20
"""Scene-linear value to which the median of the metered pixels is exposed."""
METER_BRIGHT = 0.95
METER_SIZE = 64


def main(folder: Path) -> None:
    """Renders the missing pictures."""
    threading.Thread(target=_die_with_parent, daemon=True).start()
    plan = json.loads((folder / "plan.json").read_text(encoding="utf-8"))
    jobs = [job for job in plan["jobs"] if not (folder / job["out"]).exists()]
    if not jobs:
        return
    stage = Stage(folder, plan)
    stops = _metered(folder, plan, stage)
    for done, job in enumerate(jobs, start=1):
        began = time.perf_counter()
        stage.render(job, stops, folder / job["out"])
        _say(done=done, total=len(jobs), seconds=time.perf_counter() - began, out=job["out"])


def _say(**message: Any) -> None:
    print(json.dumps(message), flush=True)


def _die_with_parent() -> None:
    while os.read(0, 64):
        pass
    os._exit(1)


class Stage:
    """The Blender scene and its rendering."""

    def __init__(self, folder: Path, plan: dict[str, Any]) -> None:
        self.folder, self.plan, self.oversize = folder, plan, plan["oversize"]
        self.key_object = self.without = None
        bpy.ops.wm.read_factory_settings(use_empty=True)
        self.scene = bpy.context.scene
        self._settings()
        # In a scene with panes, all other objects are in their own collection, a holdout in the panes' view layer.
        self.collection = self.scene.collection
        if plan.get("panes"):
            self.collection = self._collection("things")
            self._reflections()
        self._develop()
        self._world()
        for light in plan["lights"]:
            self._light(light)
        surfaces = [self._material(m["file"], m["emission"]) for m in plan["materials"]]
        self._mesh("static", surfaces, smooth=False)
        self.movers: list[tuple[Any, np.ndarray]] = []
        self.mover_names: dict[str, int] = {}
        for mover in plan["movers"]:
            created = self._mesh(mover["name"], [self._material(mover["texture"], 0.0)], smooth=True)
            created.visible_camera = mover["in_view"]
            path = folder / "geometry" / f"{mover['name']}.npy"
            self.mover_names[mover["name"]] = len(self.movers)
            self.movers.append((created.data, np.load(path, mmap_mode="r", allow_pickle=False)))
            if mover["name"] == plan.get("thing", {}).get("mover"):
                self.key_object, self.without = created, self._without(mover, created)
        self.time: tuple[float, dict[str, float]] | None = None
        camera = bpy.data.cameras.new("camera")
        camera.sensor_fit, camera.sensor_width = "HORIZONTAL", 36.0
        camera.lens = 36.0 * plan["focal_per_width"]
        camera.clip_start, camera.clip_end = 0.01, 1000.0
        self.camera = bpy.data.objects.new("camera", camera)
        self.scene.collection.objects.link(self.camera)
        self.scene.camera = self.camera

    def _settings(self) -> None:
        render, cycles = self.scene.render, self.scene.cycles
        render.engine = "CYCLES"
        render.resolution_x, render.resolution_y = (
            self.oversize * self.plan["width"],
            self.oversize * self.plan["height"],
        )
        render.resolution_percentage = 100
        render.use_persistent_data = True
        render.border_min_x, render.border_max_x = 0.0, 1.0
        render.use_crop_to_border = False
        render.use_motion_blur = False
        render.use_compositing, render.use_sequencer = True, False
        cycles.device = "CPU"
        cycles.samples = self.plan["samples"]
        cycles.use_adaptive_sampling = False
        cycles.use_denoising = False
        cycles.sampling_pattern = "BLUE_NOISE"
        cycles.max_bounces, cycles.diffuse_bounces, cycles.glossy_bounces = 3, 3, 0
        cycles.transmission_bounces = cycles.volume_bounces = 0
        cycles.caustics_reflective = cycles.caustics_refractive = False
        cycles.sample_clamp_indirect = 4.0
        cycles.use_light_tree = True
        cycles.pixel_filter_type, cycles.filter_width = "BLACKMAN_HARRIS", 1.3
        settings = render.image_settings
        settings.file_format, settings.color_mode, settings.color_depth = "OPEN_EXR", "RGB", "32"
        settings.exr_codec = "NONE"

    def _develop(self) -> None:
        """Sets up the compositor: it denoises light separately, then multiplies by the surfaces' colour.

        The colour pass is almost free of noise. A denoiser of light and texture together confuses noise and texture.
        """
        layer = self.scene.view_layers[0]
        for name in ("diffuse_direct", "diffuse_indirect", "diffuse_color", "emit", "environment"):
            setattr(layer, f"use_pass_{name}", True)
        layer.cycles.denoising_store_passes = True
        tree = bpy.data.node_groups.new("develop", "CompositorNodeTree")
        tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
        self.scene.compositing_node_group = tree
        passes, output = tree.nodes.new("CompositorNodeRLayers"), tree.nodes.new("NodeGroupOutput")
        denoise = tree.nodes.new("CompositorNodeDenoise")

        def mixed(kind: str, a: Any, b: Any) -> Any:
            node = tree.nodes.new("ShaderNodeVectorMath")
            node.operation = kind
            tree.links.new(a, node.inputs[0])
            tree.links.new(b, node.inputs[1])
            return node.outputs[0]

        light = mixed("ADD", passes.outputs["Diffuse Direct"], passes.outputs["Diffuse Indirect"])
        tree.links.new(light, denoise.inputs["Image"])
        tree.links.new(passes.outputs["Denoising Normal"], denoise.inputs["Normal"])
        lit = mixed("MULTIPLY", denoise.outputs[0], passes.outputs["Diffuse Color"])
        shining = mixed("ADD", passes.outputs["Emission"], passes.outputs["Environment"])
        tree.links.new(self._with_panes(tree, mixed, mixed("ADD", lit, shining)), output.inputs[0])

    def _collection(self, name: str) -> Any:
        created = bpy.data.collections.new(name)
        self.scene.collection.children.link(created)
        return created

    def _reflections(self) -> None:
        """Adds the panes, in a view layer that shows only their reflections; the other layer excludes them.

        A pane's only closure is the reflection, weighted by its reflectance. A surface that chose randomly between
        reflection and the world behind it would be noisy.
        """
        panes = self._collection("panes")
        for number, pane in enumerate(self.plan["panes"]):
            origin, along, up = (np.array(pane[name]) for name in ("origin", "along", "up"))
            mesh = bpy.data.meshes.new(f"pane{number}")
            corners = (origin, origin + along, origin + along + up, origin + up)
            mesh.from_pydata([corner.tolist() for corner in corners], [], [range(4)])
            mesh.materials.append(self._pane_material(pane["kind"]))
            created = bpy.data.objects.new(mesh.name, mesh)
            for ray in ("diffuse", "glossy", "transmission", "shadow", "volume_scatter"):
                setattr(created, f"visible_{ray}", False)
            panes.objects.link(created)
        layer = self.scene.view_layers.new("reflections")
        for name in ("glossy_direct", "glossy_indirect", "glossy_color"):
            setattr(layer, f"use_pass_{name}", True)
        layer.cycles.denoising_store_passes = True
        layer.layer_collection.children["things"].holdout = True
        self.scene.view_layers[0].layer_collection.children["panes"].exclude = True
        self.scene.cycles.glossy_bounces = 1
        self.scene.cycles.max_bounces = 4

    def _pane_material(self, kind: str) -> Any:
        material = bpy.data.materials.new(kind)
        material.use_nodes = True
        nodes, links = material.node_tree.nodes, material.node_tree.links
        nodes.clear()
        gloss, output = nodes.new("ShaderNodeBsdfAnisotropic"), nodes.new("ShaderNodeOutputMaterial")
        gloss.inputs["Roughness"].default_value = 0.0
        share = self.plan["reflects"][kind]
        if kind == "glass":
            fresnel = nodes.new("ShaderNodeFresnel")
            fresnel.inputs["IOR"].default_value = share
            links.new(fresnel.outputs[0], gloss.inputs["Color"])
        else:
            gloss.inputs["Color"].default_value = (share, share, share, 1.0)
        links.new(gloss.outputs[0], output.inputs["Surface"])
        return material

    def _with_panes(self, tree: Any, mixed: Any, behind: Any) -> Any:
        """Mixes in the panes' reflections: behind * (1 - reflectance) + reflection; returns `behind` without panes."""
        if not self.plan.get("panes"):
            return behind
        passes, denoise = tree.nodes.new("CompositorNodeRLayers"), tree.nodes.new("CompositorNodeDenoise")
        passes.layer = "reflections"
        light = mixed("ADD", passes.outputs["Glossy Direct"], passes.outputs["Glossy Indirect"])
        share = passes.outputs["Glossy Color"]
        # For a perfect mirror the renderer's guide passes are those of the reflected surfaces.
        for guide in ("Normal", "Albedo"):
            tree.links.new(passes.outputs[f"Denoising {guide}"], denoise.inputs[guide])
        tree.links.new(mixed("MULTIPLY", light, share), denoise.inputs["Image"])
        left = mixed("SUBTRACT", behind, mixed("MULTIPLY", behind, share))
        return mixed("ADD", left, denoise.outputs[0])

    def _without(self, mover: dict[str, Any], created: Any) -> Any:
        """A mover without the triangles of the scene's thing, initially hidden; None if all or none are removed."""
        with np.load(self.folder / "geometry" / "thing.npz", allow_pickle=False) as data:
            gone = data["gone"]
        if gone.all() or not gone.any():
            return None
        remainder = self._mesh(mover["name"], [self._material(mover["texture"], 0.0)], smooth=True, kept=~gone)
        self.movers.append((remainder.data, self.movers[-1][1]))
        remainder.hide_render = True
        return remainder

    def _hide_object(self, is_hidden: bool) -> None:
        """Hides the scene's thing, or shows it again."""
        if self.key_object:
            self.key_object.hide_render = is_hidden
        if self.without:
            self.without.hide_render = not is_hidden

    def _world(self) -> None:
        world = bpy.data.worlds.new("sky")
        self.scene.world = world
        world.use_nodes = True
        nodes, links = world.node_tree.nodes, world.node_tree.links
        nodes.clear()
        coordinate, mapping = nodes.new("ShaderNodeTexCoord"), nodes.new("ShaderNodeMapping")
        picture, background = nodes.new("ShaderNodeTexEnvironment"), nodes.new("ShaderNodeBackground")
        output = nodes.new("ShaderNodeOutputWorld")
        skies = Path(bpy.utils.resource_path("LOCAL")) / "datafiles" / "studiolights" / "world"
        picture.image = bpy.data.images.load(str(skies / f"{self.plan['sky']}.exr"))
        mapping.inputs["Rotation"].default_value[2] = self.plan["sky_turn"]
        background.inputs["Strength"].default_value = self.plan["sky_strength"]
        links.new(coordinate.outputs["Generated"], mapping.inputs["Vector"])
        links.new(mapping.outputs["Vector"], picture.inputs["Vector"])
        links.new(picture.outputs["Color"], background.inputs["Color"])
        links.new(background.outputs["Background"], output.inputs["Surface"])
        world.cycles.sampling_method = "MANUAL"
        world.cycles.sample_map_resolution = 512

    def _light(self, spec: dict[str, Any]) -> None:
        light = bpy.data.lights.new(spec["type"].lower(), spec["type"])
        light.energy, light.color = spec["energy"], spec["color"]
        if spec["type"] == "AREA":
            light.shape = "RECTANGLE"
            light.size, light.size_y = spec["size"]
            light.cycles.is_portal = spec["portal"]
        elif spec["type"] == "SUN":
            light.angle = spec["size"][0]
        else:
            light.shadow_soft_size, light.spot_size = spec["size"]
            light.spot_blend = 0.3
        created = bpy.data.objects.new(light.name, light)
        created.location = spec["location"]
        created.rotation_euler = Vector(spec["direction"]).to_track_quat("-Z", "Y").to_euler()
        created.visible_camera = False
        if self.plan.get("panes"):
            created.visible_glossy = False
        self.collection.objects.link(created)

    def _material(self, file: str, emission: float) -> Any:
        material = bpy.data.materials.new(file)
        material.use_nodes = True
        nodes, links = material.node_tree.nodes, material.node_tree.links
        surface, picture = nodes["Principled BSDF"], nodes.new("ShaderNodeTexImage")
        picture.image = bpy.data.images.load(str(self.folder / "textures" / file), check_existing=True)
        links.new(picture.outputs["Color"], surface.inputs["Base Color"])
        surface.inputs["Roughness"].default_value = 1.0
        surface.inputs["Specular IOR Level"].default_value = 0.0
        if emission:
            surface.inputs["Emission Color"].default_value = (1.0, 0.97, 0.92, 1.0)
            surface.inputs["Emission Strength"].default_value = emission
            # The surface is visible, but the area light near it does the lighting.
            material.cycles.emission_sampling = "NONE"
        return material

    def _mesh(self, name: str, materials: list[Any], smooth: bool, kept: np.ndarray | None = None) -> Any:
        with np.load(self.folder / "geometry" / f"{name}.npz", allow_pickle=False) as data:
            vertices, triangles, uv, material = (data[k] for k in ("vertices", "triangles", "uv", "material"))
        if kept is not None:
            triangles, uv, material = triangles[kept], uv[kept], material[kept]
        mesh = bpy.data.meshes.new(name)
        count = len(triangles)
        mesh.vertices.add(len(vertices))
        mesh.vertices.foreach_set("co", vertices.ravel())
        mesh.loops.add(3 * count)
        mesh.loops.foreach_set("vertex_index", triangles.ravel())
        mesh.polygons.add(count)
        mesh.polygons.foreach_set("loop_start", np.arange(0, 3 * count, 3, dtype=np.int32))
        mesh.polygons.foreach_set("material_index", material)
        mesh.polygons.foreach_set("use_smooth", np.full(count, smooth))
        mesh.uv_layers.new(name="uv").data.foreach_set("uv", uv.ravel())
        for each in materials:
            mesh.materials.append(each)
        mesh.update(calc_edges=True)
        created = bpy.data.objects.new(name, mesh)
        self.collection.objects.link(created)
        return created

    def _go_to(self, time: float, elsewhen: dict[str, float]) -> None:
        """Moves all movers to a time in fractional frames, interpolated linearly between neighbouring frames.

        `elsewhen`: {mover: another time for this mover}.
        """
        if (time, elsewhen) == self.time:
            return
        moments = [time] * len(self.movers)
        for name, target_frame in elsewhen.items():
            moments[self.mover_names[name]] = target_frame
        for moment, (mesh, vertices) in zip(moments, self.movers, strict=True):
            before = int(np.floor(moment))
            share = np.float32(moment - before)
            at = vertices[before]
            if share:
                at = (1 - share) * at + share * vertices[min(before + 1, len(vertices) - 1)]
            mesh.vertices.foreach_set("co", np.ascontiguousarray(at, np.float32).ravel())
            mesh.update()
        self.time = (time, dict(elsewhen))

    def _place_camera(self, world_to_camera: list[list[float]]) -> None:
        # OpenCV's camera looks along +z with y down, Blender's along -z with y up.
        self.camera.matrix_world = Matrix(world_to_camera).inverted() @ Matrix.Diagonal((1, -1, -1, 1))

    def render(self, job: dict[str, Any], stops: float, out: Path) -> None:
        """Renders one picture, whole or in strips of rows, each with its own time."""
        out.parent.mkdir(parents=True, exist_ok=True)
        width, height = self.plan["width"], self.plan["height"]
        render = self.scene.render
        self.scene.cycles.seed = job["noise"]
        light = np.zeros((height, width, 3), np.float32)
        if "box" in job:
            self._render_box(job, light)
        for band in [] if "box" in job else job["bands"]:
            low, high = band["rows"]
            render.use_border = high - low < height
            # Blender's border counts rows from below.
            render.border_min_y, render.border_max_y = 1.0 - high / height, 1.0 - low / height
            light[low:high] = self._exposed(job, band)[low:high]
        render.use_border = False
        partial = out.with_name(f".{out.stem}.{os.getpid()}.tmp.png")
        partial.write_bytes(png(srgb(light * 2.0 ** (stops + job["stops"]))))
        os.replace(partial, out)

    def _render_box(self, job: dict[str, Any], light: np.ndarray) -> None:
        """Renders the pixels of a box without the scene's thing; the rest stays black."""
        (left, top, right, bottom), (height, width, _) = job["box"], light.shape
        render = self.scene.render
        render.use_border = True
        render.border_min_x, render.border_max_x = left / width, right / width
        render.border_min_y, render.border_max_y = 1.0 - bottom / height, 1.0 - top / height
        self._hide_object(True)
        light[top:bottom, left:right] = self._exposed(job, job["bands"][0])[top:bottom, left:right]
        self._hide_object(False)
        render.border_min_x, render.border_max_x = 0.0, 1.0

    def _exposed(self, job: dict[str, Any], band: dict[str, Any]) -> np.ndarray:
        """[h, w, 3] scene-linear light of the band, or its mean over the moments of the open shutter."""
        elsewhen = job.get("elsewhen", {})
        if "shutter" not in job:
            return self._light_of(band, elsewhen)
        pictures = []
        for number, moment in enumerate(job["shutter"]):
            # Each moment has independent noise, which the mean reduces.
            self.scene.cycles.seed = (job["noise"] + number) % (1 << 31)
            pictures.append(self._light_of(moment, elsewhen))
        return np.mean(pictures, axis=0)

    def _light_of(self, band: dict[str, Any], elsewhen: dict[str, float] | None = None) -> np.ndarray:
        """[h, w, 3] scene-linear light, rows downwards, averaged from rendered pixels to picture pixels."""
        self._go_to(band["time"], elsewhen or {})
        self._place_camera(band["world_to_camera"])
        path = self.folder / f".render.{os.getpid()}.exr"
        self.scene.render.filepath = str(path)
        bpy.ops.render.render(write_still=True)
        picture = bpy.data.images.load(str(path))
        picture.colorspace_settings.name = "Non-Color"
        width, height = picture.size
        values = np.empty(width * height * 4, np.float32)
        picture.pixels.foreach_get(values)
        bpy.data.images.remove(picture)
        path.unlink()
        fine = values.reshape(height // self.oversize, self.oversize, width // self.oversize, self.oversize, 4)
        return fine.mean(axis=(1, 3))[::-1, :, :3]

    def meter(self) -> float:
        """Stops that expose the clip well, like the locked exposure of a camera."""
        render = self.scene.render
        frames = [job for job in self.plan["jobs"] if job["out"].startswith("frames/")]
        size = render.resolution_x, render.resolution_y
        render.resolution_x = self.oversize * METER_SIZE
        render.resolution_y = self.oversize * max(8, round(METER_SIZE * size[1] / size[0]))
        values = []
        for job in (frames[0], frames[len(frames) // 2], frames[-1]):
            band = {**job["bands"][0], "time": round(job["bands"][0]["time"])}
            values.append(self._light_of(band).reshape(-1, 3) @ [0.2126, 0.7152, 0.0722])
        render.resolution_x, render.resolution_y = size
        light = np.concatenate(values)
        middle, bright = np.median(light), np.quantile(light, 0.92)
        return float(np.log2(min(METER_GREY / max(middle, 1e-6), METER_BRIGHT / max(bright, 1e-6))))


def srgb(light: np.ndarray) -> np.ndarray:
    """Scene-linear [H, W, 3] as 8-bit sRGB (IEC 61966-2-1), equal to Blender's view transform Standard."""
    light = np.clip(light, 0.0, 1.0)
    encoded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-8) ** (1 / 2.4) - 0.055)
    return np.round(255.0 * encoded).astype(np.uint8)


def png(pixels: np.ndarray) -> bytes:
    """A PNG of [H, W, 3] uint8 with pixels only; PNGs written by Blender also contain the date and render time."""
    height, width, _ = pixels.shape
    # Filter 1 (Sub) in every row: each byte minus the same byte of the previous pixel.
    rows = pixels.copy()
    rows[:, 1:] -= pixels[:, :-1]
    data = np.concatenate([np.ones((height, 1), np.uint8), rows.reshape(height, -1)], axis=1).tobytes()
    chunks = [
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)),
        (b"sRGB", b"\0"),
        (b"IDAT", zlib.compress(data, 6)),
        (b"IEND", b""),
    ]
    whole = (struct.pack(">I", len(d)) + n + d + struct.pack(">I", zlib.crc32(n + d)) for n, d in chunks)
    return b"\x89PNG\r\n\x1a\n" + b"".join(whole)


def _metered(folder: Path, plan: dict[str, Any], stage: Stage) -> float:
    """The clip's exposure in stops, measured once and then read from meter.json."""
    path = folder / "meter.json"
    if path.exists():
        return json.loads(path.read_text(encoding="utf-8"))["stops"]
    stops = stage.meter()
    record = {"stops": stops, "bpy": bpy.app.version_string, "threads": stage.scene.render.threads}
    partial = path.with_name(f".meter.{os.getpid()}.tmp")
    partial.write_text(json.dumps(record) + "\n", encoding="utf-8")
    os.replace(partial, path)
    return stops


if __name__ == "__main__":
    arguments = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    main(Path(arguments[0]))
