"""Reads and writes Gaussians as a standard 3DGS PLY, which SuperSplat, KIRI's add-on, Nuke and Houdini can open.

Layout of the original 3D Gaussian Splatting code (graphdeco-inria/gaussian-splatting, scene/gaussian_model.py,
`save_ply`): binary little endian, float32, per vertex x y z, nx ny nz (zeros), f_dc_0..2, f_rest_0..(3(K-1)-1)
channel-major (all bases of red, then of green, then of blue), opacity (logit), scale_0..2 (log), rot_0..3 (wxyz).
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..contract import LONGEST_CHECKPOINT, open_regular, read_ply_header
from ..shot import atomic_path

SH_BASES = (1, 4, 9, 16)
"""K for SH degrees 0 to 3."""


class PlyGaussians(NamedTuple):
    """Gaussians as stored, without activation functions, in the world frame of the file."""

    means: NDArray[np.float32]
    """[N,3] in world units."""
    quats: NDArray[np.float32]
    """[N,4] wxyz, not normalised."""
    log_scales: NDArray[np.float32]
    """[N,3]."""
    opacity_logits: NDArray[np.float32]
    """[N]."""
    sh: NDArray[np.float32]
    """[N,K,3], K = (degree + 1)^2; [:,0] is the constant band."""


def property_names(bases: int) -> list[str]:
    """Names of the vertex properties in file order, for K SH bases."""
    return [
        *("x", "y", "z", "nx", "ny", "nz"),
        *(f"f_dc_{i}" for i in range(3)),
        *(f"f_rest_{i}" for i in range(3 * (bases - 1))),
        "opacity",
        *(f"scale_{i}" for i in range(3)),
        *(f"rot_{i}" for i in range(4)),
    ]


def write_ply(
    path: str | Path,
    means: ArrayLike,  # [N,3]
    quats: ArrayLike,  # [N,4] wxyz
    log_scales: ArrayLike,  # [N,3]
    opacity_logits: ArrayLike,  # [N]
    sh: ArrayLike,  # [N,K,3]
) -> Path:
    """Writes the Gaussians atomically, without changing frame or units; values are cast to float32.

    ValueError names an array with a wrong shape, or with NaN or infinity. OSError if the file cannot be written.
    """
    gaussians = PlyGaussians(
        *(np.asarray(array, dtype=np.float32) for array in (means, quats, log_scales, opacity_logits, sh))
    )
    _check(gaussians)
    count, bases = gaussians.sh.shape[:2]
    names = property_names(bases)
    header = "\n".join(
        ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
        + [f"property float {name}" for name in names]
        + ["end_header\n"]
    )
    rows = np.concatenate(
        [
            gaussians.means,
            np.zeros((count, 3), dtype=np.float32),
            gaussians.sh[:, 0],
            gaussians.sh[:, 1:].transpose(0, 2, 1).reshape(count, 3 * (bases - 1)),
            gaussians.opacity_logits[:, None],
            gaussians.log_scales,
            gaussians.quats,
        ],
        axis=1,
        dtype="<f4",
    )
    path = Path(path)
    with atomic_path(path) as partial, open(partial, "wb") as handle:
        handle.write(header.encode("ascii"))
        handle.write(rows.data)  # `tofile` does not report a full disk
    return path


def read_ply(path: str | Path) -> PlyGaussians:
    """Reads a binary 3DGS PLY of SH degree 0 to 3; other vertex properties and elements are skipped.

    FileNotFoundError if the file is missing. ValueError if it is not such a PLY, is truncated, or has NaN or infinity.
    """
    path = Path(path)
    with open_regular(path, LONGEST_CHECKPOINT) as handle:
        count, layout = vertex_layout(handle, path)
        need, available = count * layout.itemsize, os.fstat(handle.fileno()).st_size - handle.tell()
        if available < need:
            raise ValueError(
                f"{path}: cut short, {count} Gaussians need {need} bytes, but only {available} are present"
            )
        rows = np.fromfile(handle, dtype=layout, count=count)
    fields = rows.dtype.names or ()
    higher = sum(name.startswith("f_rest_") for name in fields)
    bases = higher // 3 + 1
    if higher % 3 or bases not in SH_BASES:
        raise ValueError(f"{path}: {higher} f_rest properties; degrees 0 to 3 have 0, 9, 24 or 45")
    missing = [name for name in property_names(bases) if name not in fields and name not in ("nx", "ny", "nz")]
    if missing:
        raise ValueError(f"{path}: not a 3D Gaussian PLY, the vertices have no {', '.join(missing[:4])}")

    def columns(*names: str) -> NDArray[np.float32]:
        return np.stack([rows[name] for name in names], axis=-1).astype(np.float32)

    sh = np.empty((count, bases, 3), dtype=np.float32)
    sh[:, 0] = columns("f_dc_0", "f_dc_1", "f_dc_2")
    if higher:
        sh[:, 1:] = columns(*(f"f_rest_{i}" for i in range(higher))).reshape(count, 3, bases - 1).transpose(0, 2, 1)
    gaussians = PlyGaussians(
        columns("x", "y", "z"),
        columns("rot_0", "rot_1", "rot_2", "rot_3"),
        columns("scale_0", "scale_1", "scale_2"),
        rows["opacity"].astype(np.float32),
        sh,
    )
    _check(gaussians, f"{path}: ")
    return gaussians


def _check(gaussians: PlyGaussians, prefix: str = "") -> None:
    count = gaussians.means.shape[0] if gaussians.means.ndim else 0
    bases = gaussians.sh.shape[1] if gaussians.sh.ndim == 3 else 0
    if bases not in SH_BASES:
        raise ValueError(f"{prefix}sh should be [N,K,3] with K one of {SH_BASES}, got shape {gaussians.sh.shape}")
    shapes = ((count, 3), (count, 4), (count, 3), (count,), (count, bases, 3))
    for name, array, shape in zip(gaussians._fields, gaussians, shapes, strict=True):
        if array.shape != shape:
            raise ValueError(f"{prefix}{name} should have shape {shape}, got {array.shape}")
        if not np.isfinite(array).all():
            bad = int((~np.isfinite(array.reshape(count, -1))).any(axis=1).sum())
            raise ValueError(f"{prefix}{name} of {bad} Gaussians is not finite")


def vertex_layout(handle: BinaryIO, path: Path) -> tuple[int, np.dtype]:
    """(number of vertices, dtype of a vertex). Leaves the handle at the first vertex. ValueError as `read_ply`."""
    count, fields = read_ply_header(handle, path)
    return count, np.dtype(fields)
