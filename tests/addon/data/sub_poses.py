"""Writes the camera poses during one exposure, as the backend computes them, for a test of the add-on.

    python tests/addon/data/sub_poses.py REPOSITORY PATH.json FRAME DEPTH OUT.json      (with the backend's Python)

OUT gets a list of world-to-camera matrices, 16 numbers each, for a shutter of 180 degrees and a wall at DEPTH.
"""

import json
import sys
from pathlib import Path


def main(root: str, path: str, frame: str, depth: str, out: str) -> None:
    """Write OUT."""
    sys.path.insert(0, root)
    import torch

    from torch_backend.contract import CameraPath
    from torch_backend.freeze.frozen import OutputFrame
    from torch_backend.freeze.take.motion_blur import MotionBlur

    frames: list[OutputFrame] = []
    for one in (camera_path := CameraPath.load(path)).frames:
        fx, fy, cx, cy = one.K
        K = torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        frames.append(OutputFrame(one.frame, torch.tensor(one.viewmat).reshape(4, 4), K, 1.0, 1.0))
    middle = next(each for each in frames if each.frame == int(frame))
    wall = torch.full((camera_path.height, camera_path.width), float(depth))
    cameras = [*MotionBlur(frames, 180.0).sample_cameras(middle, middle.K, wall), middle]
    Path(out).write_text(json.dumps([camera.viewmat.flatten().tolist() for camera in cameras]))


if __name__ == "__main__":
    main(*sys.argv[1:])
