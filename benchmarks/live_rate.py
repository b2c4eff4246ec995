"""Views per second of a live session at 320 x 180: `python -m benchmarks.live_rate SHOT [--run main]`."""

import argparse
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO, cast

from torch_backend.contract import CameraPath, python_child, read_message, write_message

SIZE = (320, 180)


def main() -> None:
    """Requests views one after another: t* over all trained frames, then all poses at a fixed t*."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("shot")
    parser.add_argument("--run", default="main")
    parser.add_argument("--rounds", type=int, default=3)
    args = parser.parse_args()
    path = CameraPath.load(f"{args.shot}/solve/cameras.json")
    command = python_child(sys.executable, "torch_backend", "live", os.path.abspath(args.shot), "--run", args.run)
    root = str(Path(__file__).resolve().parents[1])
    environment = {**os.environ, "PYTHONPATH": root, "PYTHONSAFEPATH": "1"}
    child = subprocess.Popen(**command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    requests, answers = cast("BinaryIO", child.stdin), cast("BinaryIO", child.stdout)
    ready = read_message(answers)
    if ready is None or ready[0]["kind"] != "ready":
        raise SystemExit(f"the session did not begin: {ready}")
    trained = ready[0]["trained"]

    def view(pose: int, t_star: int) -> dict[str, Any]:
        camera, grown = path.frames[pose % len(path.frames)], SIZE[0] / path.width
        k = [camera.K[0] * grown, camera.K[1] * grown, SIZE[0] / 2, SIZE[1] / 2]
        about = {"view": 1, "seq": 0, "viewmat": camera.viewmat, "K": k, "t_star": float(t_star)}
        return {"kind": "view", **about, "width": SIZE[0], "height": SIZE[1]}

    def sweep(name: str, request_of: Callable[[int], dict[str, Any]], count: int = 200) -> None:
        spent = []
        for n in range(count):
            since = time.perf_counter()
            write_message(requests, request_of(n))
            answer = read_message(answers)
            if answer is None or answer[0]["kind"] != "frame":
                raise SystemExit(f"no frame came: {answer and answer[0]}")
            spent.append(1e3 * (time.perf_counter() - since))
        print(
            f"{name}: {1e3 * count / sum(spent):.1f} a second, "
            f"{statistics.median(spent):.1f} ms, at most {max(spent):.1f}"
        )

    for _ in range(args.rounds):
        sweep("t* sweep", lambda n: view(len(path.frames) // 2, trained[3 * n % len(trained)]))
        sweep("all poses", lambda n: view(n, trained[len(trained) // 2]))
    requests.close()
    child.wait()


if __name__ == "__main__":
    main()
