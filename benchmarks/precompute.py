"""`legs precompute` beside decoding the same JPEGs with Pillow alone, on as many processes. Writes JSON.

    python benchmarks/precompute.py --workers 2 --resolution -1

Photographs of 12 megapixels are drawn into a temporary folder. Both sides take turns, and each run starts its processes
anew: whole runs with two numbers of photographs are timed, and the difference is what the additional ones cost, on the
clock and of the processors' time, which other work on the machine changes less. The memory is a worker's peak, all of
it.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import resource
import statistics
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, Dict, List

import numpy as np
from PIL import Image

from legs_loss.precompute import precompute
from legs_loss.scenes import read_scene

WIDTH, HEIGHT = 4000, 3000


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--resolution", type=int, default=-1, help="3DGS's -r")
    parser.add_argument("--photographs", type=int, default=48)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--json")
    args = parser.parse_args()
    few = args.workers
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        scenes = {count: draw(root / str(count), count) for count in (few, few + args.photographs)}
        costs: Dict[str, List[np.ndarray]] = {"precompute": [], "decode": []}
        for i in range(args.rounds + 1):
            for name, run in (("precompute", compute), ("decode", decode)):
                cost = timed(run, scenes[few + args.photographs], args) - timed(run, scenes[few], args)
                if i > 0:  # the first compiles, and fills the file cache
                    costs[name].append(1e3 * cost / args.photographs)
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:  # a process without other children
            peak = pool.submit(worker_peak, scenes[few], args).result()
    result: Dict[str, Any] = {"workers": args.workers, "resolution": args.resolution, "photographs": args.photographs}
    for column, clock in enumerate(("", ", processors' time")):
        precomputing, decoding = (np.array(costs[name])[:, column] for name in ("precompute", "decode"))
        ratios = list(precomputing / decoding)
        result[f"precompute ms a photograph{clock}"] = list(precomputing)
        result[f"decode ms a photograph{clock}"] = list(decoding)
        result[f"ratio{clock}"] = [statistics.median(ratios), min(ratios), max(ratios)]
    result["worker peak MB"] = peak / 1e6
    print(json.dumps(result, indent=1))
    if args.json:
        Path(args.json).write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


def timed(run: Any, scene: Path, args: argparse.Namespace) -> np.ndarray:
    """Return the seconds that it takes, with its processes' start and end, and the processors' seconds."""
    used, start = _processor_time(), time.perf_counter()
    run(scene, args)
    return np.array([time.perf_counter() - start, _processor_time() - used])


def _processor_time() -> float:
    usages = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def compute(scene: Path, args: argparse.Namespace) -> None:
    """Make the maps of a folder of photographs by the package."""
    with tempfile.TemporaryDirectory() as out:
        report = precompute(read_scene(scene), out=out, resolution=args.resolution, workers=args.workers)
        assert not report.skipped and not report.kept


def decode(scene: Path, args: argparse.Namespace) -> None:
    """Decode it by Pillow, with as many processes."""
    with multiprocessing.get_context("spawn").Pool(args.workers) as pool:
        pool.map(load, sorted(scene.glob("*.jpg")), chunksize=1)
        pool.close()
        pool.join()


def load(path: Path) -> None:
    with Image.open(str(path)) as image:
        image.load()


def worker_peak(scene: Path, args: argparse.Namespace) -> int:
    """Return the peak memory in bytes of the larger one of the processes that make maps."""
    compute(scene, args)
    return 1024 * resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss


def draw(folder: Path, count: int) -> Path:
    """Write photographs: smooth shapes under the noise of a sensor, about 5 MB each."""
    folder.mkdir(parents=True)
    generator = np.random.RandomState(0)
    coarse = Image.fromarray(generator.randint(0, 255, (HEIGHT // 10, WIDTH // 10, 3)).astype(np.uint8))
    smooth: Any = np.asarray(coarse.resize((WIDTH, HEIGHT))).astype(np.int16)
    noise = generator.randint(-12, 12, smooth.shape).astype(np.int16)
    data = Image.fromarray((smooth + noise).clip(0, 255).astype(np.uint8))
    data.save(str(folder / "0000.jpg"), quality=92)
    for i in range(1, count):
        (folder / f"{i:04}.jpg").write_bytes((folder / "0000.jpg").read_bytes())
    return folder


if __name__ == "__main__":
    main()
