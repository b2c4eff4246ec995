"""Table of the layers of a frozen frame and of its mattes, for EXR writers, compositor and manual."""

from __future__ import annotations

from dataclasses import dataclass

NO_DEPTH = 1e10
"""Depth of a pixel that nothing covers, as in Blender's Z pass."""


@dataclass(frozen=True)
class FrameLayer:
    """One layer of takes/NAME/NNNNNN.exr, or of a take's file of mattes."""

    name: str
    """Name of the layer's socket on Blender's Image node, 4.2 to 5.2."""
    channels: tuple[str, ...]
    """Channels of the file, in order. Blender reads a single channel such as Support.V as a value, R G B A as a colour
    (freeze/exr.py)."""
    stored: str
    """Number format in the file: half or float."""
    shown: str
    """Its channels as docs/reference.md writes them."""
    content: str
    """Description of its content, for docs/reference.md."""
    part: str = ""
    """Group of layers. Empty: in every frame; grain, detail: in frames with grain or detail. Other groups are only in
    frames whose writer gets them as `more`; this table alone defines how they are stored."""
    output: str = ""
    """Output of the compositor group for this layer; empty: none. Outputs of passes only exist in takes with passes."""
    tip: str = ""
    """Tooltip of that output."""
    socket: str = "NodeSocketFloat"
    """Type of that output."""

    @property
    def is_colour(self) -> bool:
        """True if the layer holds light in the primaries of the file's header. False for numbers such as positions."""
        return len(self.channels) > 1 and self.channels[0].endswith("R")


FRAME_LAYERS = (
    FrameLayer(
        "Combined",
        ("R", "G", "B", "A"),
        "half",
        "R G B A",
        "scene-linear, premultiplied; primaries: in the header, the footage's (ACEScg, ...) or Rec.709's",
        output="Image",
        tip="Frozen frame, scene-linear",
        socket="NodeSocketColor",
    ),
    FrameLayer(
        "Depth",
        ("Z",),
        "float",
        "Z",
        "depth along the camera's axis, in solve units (scaled to the scene's at bake); 1e10 where alpha is 0",
        output="Depth",
        tip="Distance along the camera's axis in scene units; 1e10 where there is nothing",
    ),
    FrameLayer(
        "DepthSigma",
        ("DepthSigma.V",),
        "half",
        "DepthSigma.V",
        "standard deviation of the depth, in the same units; large where the depth is uncertain",
        part="sigma",
    ),
    FrameLayer(
        "Support",
        ("Support.V",),
        "half",
        "Support.V",
        "1: this surface was seen near t*; 0: it is a guess",
        output="Support",
        tip="1 where the footage saw this at the frozen instant, 0 where it is a guess",
    ),
    FrameLayer(
        "Motion",
        ("Motion.V",),
        "half",
        "Motion.V",
        "how much of the pixel belongs to something that moves in the clip, at t* or in the frame's own plate",
        output="Motion",
        tip="1 where things move in the footage, 0 where they never do",
    ),
    FrameLayer(
        "Grain",
        ("Grain.R", "Grain.G", "Grain.B", "Grain.A"),
        "half",
        "Grain.R G B",
        "grain to add to `R G B` to match the plate, different on every frame; 0 where the pixel comes from a plate",
        part="grain",
    ),
    FrameLayer(
        "Splat",
        ("Splat.R", "Splat.G", "Splat.B", "Splat.A"),
        "half",
        "Splat.R G B A",
        "the frame rendered from splats only; not with `--detail off`, like the next two",
        part="detail",
    ),
    FrameLayer(
        "Plate",
        ("Plate.V",),
        "half",
        "Plate.V",
        "share of the pixel that comes from plates; 0: only from splats",
        part="detail",
        output="Plate",
        tip="1 where the pixel comes from plates, 0 where it comes from splats",
    ),
    FrameLayer(
        "Source",
        ("Source.V",),
        "float",  # a half is exact for integers up to 2048 only
        "Source.V",
        "number of the frame whose plate gives most of the pixel; 0 where none does",
        part="detail",
        output="Source",
        tip="Number of the frame whose plate gives most of the pixel",
    ),
    FrameLayer(
        "Vector",
        ("Vector.X", "Vector.Y", "Vector.Z", "Vector.W"),
        "half",
        "Vector.X Y Z W",
        "motion from the camera move in pixels, y up, like Blender's Vector pass: from here to the frame before in X "
        "Y, from the frame after to here in Z W; with `--passes`, like the next four",
        part="passes",
        output="Vector",
        tip="Motion from the camera move in pixels of the frozen frames, for the Vector Blur node",
        socket="NodeSocketColor",  # keeps all four numbers in 4.2 to 5.2
    ),
    # Names of Nuke's layers. Blender uses Vector: 4.2 and 5.2 show sockets for two channels, but without values.
    FrameLayer(
        "forward",
        ("forward.u", "forward.v"),
        "half",
        "forward.u v",
        "the same motion as Nuke's built-in layer stores it, in pixels, y up: from here to the frame after",
        part="passes",
    ),
    FrameLayer(
        "backward",
        ("backward.u", "backward.v"),
        "half",
        "backward.u v",
        "from here to the frame before, like Nuke's built-in layer",
        part="passes",
    ),
    FrameLayer(
        "Normal",
        ("Normal.X", "Normal.Y", "Normal.Z"),
        "half",
        "Normal.X Y Z",
        "direction that the surface faces, in the scene's axes",
        part="passes",
        output="Normal",
        tip="Direction that the surface faces, in the scene's axes",
        socket="NodeSocketVector",
    ),
    FrameLayer(
        "Position",
        ("Position.X", "Position.Y", "Position.Z"),
        "float",
        "Position.X Y Z",
        "position of the surface in the scene's axes and units, with the shot's placement at the time of the freeze",
        part="passes",
        output="Position",
        tip="Position of the surface in the scene's axes and units",
        socket="NodeSocketVector",
    ),
)
"""Layers of a frozen frame, in the order of the file."""

CRYPTOMATTE = "Mattes"
"""Name of the Cryptomatte of a take's mattes, and `part` of its layers."""
MATTE_LAYERS = tuple(
    FrameLayer(
        f"{CRYPTOMATTE}{n:02d}",
        tuple(f"{CRYPTOMATTE}{n:02d}.{channel}" for channel in "RGBA"),
        "float",
        f"{CRYPTOMATTE}{n:02d}.R G B A",
        f"mattes {2 * n + 1} and {2 * n + 2} of the pixel: identifier and share, twice",
        part=CRYPTOMATTE,
        socket="NodeSocketColor",
    )
    for n in range(3)  # six mattes per pixel, as other programs write
)
"""Layers of takes/NAME/mattes/cryptomatte/NNNNNN.exr, in the order of the file (Cryptomatte specification 1.2.0)."""


def layers_of(part: str) -> tuple[FrameLayer, ...]:
    """The layers of a part, in the order of the file."""
    return tuple(layer for layer in (*FRAME_LAYERS, *MATTE_LAYERS) if layer.part == part)


def channels_of(part: str) -> tuple[str, ...]:
    """Channel names of a part's layers, in the order of the file."""
    return tuple(channel for layer in layers_of(part) for channel in layer.channels)
