"""Damage files at random and read them with every reader of the package, which must keep its promises.

    python -m benchmarks.fuzz --minutes 10
    python -m benchmarks.fuzz --cases 10000 --seed 7 --readers store colmap

Of every case: whatever the bytes are, the reader returns or raises the one error of bad input (LegsError), within
seconds, and writes nothing outside of its folder. Of a patch, too: what compiled still compiles, and the undo gives
back every byte. A case is named by the seed and its number; what fails is kept in --keep.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import random
import re
import shutil
import signal
import struct
import sys
import tempfile
import time
import traceback
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any, Callable, Dict, Iterator, List, Optional, Set, Tuple

import numpy as np
from legs_adapters.journal import JOURNAL
from legs_adapters.plan import plan, write
from legs_adapters.undo import undo
from PIL import Image

from legs_loss.config import find_config
from legs_loss.errors import LegsError
from legs_loss.lab.embedded import write_embedded_scene
from legs_loss.lab.gaussians import Gaussians
from legs_loss.lab.ply import read_ply, write_ply
from legs_loss.lab.training.checkpoint import read_state, write_checkpoint
from legs_loss.lab.viewer.server import splats
from legs_loss.precompute import precompute
from legs_loss.scenes import View, load_training_image, read_scene
from legs_loss.store import Entry, WeightStore
from legs_loss.store.manifest import MANIFEST, manifest_bytes, read_manifest

SECONDS = 30  # of the processor that a case may take
PIECES = [b"\0", b"\xff" * 8, b"-1", b"1e999", b"NaN", b'"', b"[" * 50, b"{", b"(" * 50, b"\n", b"\r", b"#", b"    "]
PIECES += [b"\xef\xbb\xbf", b"../", b".git", b"lambda: ", (1 << 60).to_bytes(8, "little"), b"\0\0\0\x80"]
PIECES += [struct.pack(kind, value) for kind in ("<f", "<d") for value in (math.nan, math.inf, -math.inf, 3e38)]
# What stands in place of a number in a text, and of an array in a checkpoint.
VALUES = [b"9" * 400, b"-" + b"9" * 400, b"1" + b"0" * 30, b"9" * 5000, b"%d" % (1 << 63), b"-1", b"0", b"0.5"]
VALUES += [b"1e308", b"1e999", b"-1e999", b"NaN", b"Infinity", b"nan", b"inf", b"true", b"null", b'""', b'"1"']
VALUES += [b"[]", b"{}", b"[[1]]"]
KINDS = ["int64", "uint8", "bool", "float16", "float64", "complex64", "U4", "S3", "M8[s]", ">f4"]
NUMBER = re.compile(rb"-?\d+(\.\d+)?([eE][-+]?\d+)?")
TRAIN = b"""import torch
from utils import l1_loss, ssim
from gaussian_renderer import render


def training(scene, gaussians, opt):
    for iteration, viewpoint_cam in enumerate(scene):
        image = render(viewpoint_cam, gaussians, None, None)["render"]
        gt_image = viewpoint_cam.original_image.cuda()
        Ll1 = l1_loss(image, gt_image)
        loss = (1.0 - opt.lambda_dssim) * Ll1 + opt.lambda_dssim * (1.0 - ssim(image, gt_image))
        loss.backward()
"""
UTILS = b"def l1_loss(network_output, gt):\n    return torch.abs((network_output - gt)).mean()\n"
TOML = b'preset = "legs"\nbeta = 10.0\ncurve = "C3"\noperator = "laplacian"\nstore = "maps"\n'

# A reader: the folder that is damaged, the files in it that are, and what reads it.
Reader = Tuple[Callable[[Path], None], List[str], Callable[[Path], Any]]


def damage(data: bytes, at: random.Random) -> bytes:
    """Return bytes with one number replaced, or with one to four accidents."""
    numbers = list(NUMBER.finditer(data))
    if numbers and at.random() < 0.4:
        found = at.choice(numbers)
        return data[: found.start()] + at.choice(VALUES) + data[found.end() :]
    changed = bytearray(data)
    for _ in range(at.randint(1, 4)):
        place, what = at.randrange(len(changed) + 1), at.randrange(6)
        if what == 0 and changed:
            changed[place % len(changed)] ^= 1 << at.randrange(8)
        elif what == 1:
            del changed[place : place + at.choice([1, 1, 4, 8, 100, len(changed)])]
        elif what == 2:
            changed[place:place] = at.choice(PIECES)
        elif what == 3:
            piece = at.choice(PIECES)
            changed[place : place + len(piece)] = piece
        elif what == 4:
            other = at.randrange(len(changed) + 1)
            changed[place:place] = changed[other : other + at.choice([1, 10, 100])]
        elif changed:
            changed[place % len(changed)] = at.randrange(256)
    return bytes(changed)


def make_scene(folder: Path) -> None:
    write_embedded_scene(folder, views=3, width=24, height=16, points=30, samples=1)


def make_text_scene(folder: Path) -> None:
    """Write a scene in COLMAP's text format, whose files are read as strictly."""
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text("# cameras\n1 PINHOLE 24 16 20 20 12 8\n2 OPENCV 24 16 20 20 12 8 0 0 0 0\n")
    (model / "images.txt").write_text("# images\n1 1 0 0 0 0 0 1 1 a b.png\n\n2 0.5 0.5 0.5 0.5 1 2 3 2 c.png\n1 2 3\n")
    (model / "points3D.txt").write_text("# points\n1 0 0 1 255 0 7 0.5 1 0\n2 1 2 3 0 0 0 0.1\n")
    (folder / "images").mkdir()


def make_transforms(folder: Path) -> None:
    (folder / "images").mkdir(parents=True)
    Image.new("RGB", (8, 6)).save(str(folder / "images" / "0.png"))
    pose = np.eye(4).tolist()
    frames = [{"file_path": "images/0.png", "transform_matrix": pose, "w": 8, "h": 6, "fl_x": 9.0}]
    frames.append({"file_path": "./images/0", "transform_matrix": pose, "camera_angle_x": 0.7})
    (folder / "transforms.json").write_text(json.dumps({"camera_angle_x": 0.69, "frames": frames}))


def make_images(folder: Path) -> None:
    pixels = np.random.RandomState(0).randint(0, 255, (13, 17, 3)).astype(np.uint8)
    for suffix in ("png", "jpg", "webp", "tif", "bmp", "gif", "ppm"):
        Image.fromarray(pixels).save(str(folder / f"a.{suffix}"))


def make_store(folder: Path) -> None:
    make_images(folder)
    for path in folder.glob("a.[!p]*"):
        path.unlink()
    precompute(read_scene(folder), folder / "store")


def some_gaussians() -> Gaussians:
    points = np.random.RandomState(0).rand(9, 3)
    return Gaussians.from_points(points.astype(np.float32), np.full((9, 3), 9, np.uint8), 1)


def make_checkpoint(folder: Path) -> None:
    import torch

    from legs_loss.lab.training.adam import Adam

    arrays = dict(
        Adam(some_gaussians()).state(), gradient_sum=np.zeros(9, np.float32), times_seen=np.zeros(9, np.float32)
    )
    facts = {"config": {}, "views": ["a"], "iteration": 3, "clocks": [0.0, 0.0], "order": [0], "loss": 0.5}
    facts.update(psnr=9.0, growth=[[45, 18]], history=[{"iteration": 3, "train_psnr": 9.5}])
    write_checkpoint(folder / "c.npz", dict(arrays, generator=torch.Generator().get_state().numpy()), facts)
    resume(folder)  # which compiles what it needs, outside of a case's time


def make_arrays(folder: Path) -> None:
    make_checkpoint(folder)
    (folder / "which").write_bytes(b"the bytes that choose what is changed")


def read_arrays(folder: Path) -> None:
    """Resume from a checkpoint in good form with an array of another kind or other values, or another fact."""
    at = random.Random((folder / "which").read_bytes())
    with np.load(str(folder / "c.npz")) as file:
        arrays = {name: file[name] for name in file.files}
    facts = arrays.pop("__facts__").tobytes()
    name = at.choice(sorted(arrays))
    if at.random() < 0.3:
        found = at.choice(list(NUMBER.finditer(facts)))
        facts = facts[: found.start()] + at.choice(VALUES) + facts[found.end() :]
    elif at.random() < 0.5:
        with contextlib.suppress(TypeError, ValueError, OverflowError):  # no such change
            arrays[name] = arrays[name].astype(at.choice(KINDS))
    else:
        with contextlib.suppress(ValueError, OverflowError):
            arrays[name] = np.array(arrays[name])
            arrays[name].flat[at.randrange(arrays[name].size)] = at.choice([math.nan, math.inf, 3e38, -1, 1 << 62])
    np.savez(str(folder / "c.npz"), __facts__=np.frombuffer(facts, np.uint8), **arrays)
    resume(folder)


def resume(folder: Path) -> None:
    """Take a step from a checkpoint."""
    import torch

    from legs_loss.lab.training.adam import FIELDS, Adam

    arrays, facts = read_state(folder / "c.npz")
    adam = Adam.restore(arrays)
    for name in FIELDS:
        parameter = getattr(adam.gaussians, name)
        parameter.grad = torch.zeros_like(parameter)
    adam.step(1e-3)
    assert all(torch.isfinite(getattr(adam.gaussians, name)).all() for name in FIELDS)
    (torch.from_numpy(arrays["gradient_sum"]) + torch.zeros(9)).norm() / torch.from_numpy(arrays["times_seen"]).sum()
    0.6 * float(facts["loss"] or 0) + 0.6 * float(facts["psnr"] or 0)
    np.array(facts["clocks"], np.float64).reshape(2)
    [(iteration + 1, count + 1) for iteration, count in facts["growth"]]


BASELINE = {"views": 2, "loss": 0.5, "loss_3dgs": 0.5, "gradient_error": 1e-7}


def make_comparison(folder: Path) -> None:
    """Write a comparison of one row, as ``legs compare`` does."""
    from legs_loss.lab.experiments.running import read_rows, write_json
    from legs_loss.lab.training.config import TrainConfig

    scene = {"name": "a", "views": 2, "sha256": "0" * 16}
    base = TrainConfig(densify_grad_threshold=1e-3).as_dict()
    settings = {"scene": scene, "path": "/nowhere", "images": None, "base": base, "baseline": BASELINE}
    write_json(folder / "comparison.json", settings)
    scores = {"psnr": 20.5, "ssim": 0.5}
    metrics = {"train": scores, "test": scores, "gaussians": 9, "mean_weight": 2.5, "seconds": 1.5, "iterations": 30}
    metrics.update(growth=[[45, 18]], history=[{"iteration": 30, "train_psnr": 15.5}])
    metrics.update(views={"train": {"images/a.png": scores}, "test": {"images/b.png": scores}})
    row = {"arm": "legs", "seed": 0, "config": base, "caps": [[45, 18]]}
    row.update(versions={"legs_loss": "0.1.0"}, metrics=metrics)
    write_json(folder / "legs" / "seed-0" / "row.json", row)
    read_rows(folder)


def read_comparison(folder: Path) -> None:
    from legs_loss.lab.experiments.arms import parse_arm
    from legs_loss.lab.experiments.running import read_rows
    from legs_loss.lab.experiments.tables import scores_table
    from legs_loss.lab.report import html
    from legs_loss.lab.report.html_pictures import ViewPictures

    settings, rows = read_rows(folder)
    for row in rows:
        place = (folder / parse_arm(row["arm"]).folder / f"seed-{row['seed']}").resolve()
        assert folder.resolve() in place.parents, f"{place} is outside"
    arms = sorted({row["arm"] for row in rows})
    scores_table(rows, arms)
    html._page(
        settings, rows, arms, [ViewPictures("a", 8, 6, {}, 1.0, 1.0, {})], {row["arm"]: row for row in rows}, folder
    )


def make_checkout(folder: Path) -> None:
    (folder / "train.py").write_bytes(TRAIN)
    (folder / "utils.py").write_bytes(UTILS)


def make_patched(folder: Path) -> None:
    make_checkout(folder)
    write(plan(folder))


def read_maps(folder: Path) -> None:
    """Read a store of damaged maps whose manifest agrees with them, as a stranger would write it."""
    entries = read_manifest(folder / "store")
    data = {entry.file: (folder / "store" / entry.file).read_bytes() for entry in entries}
    true = [replace(e, bytes=len(data[e.file]) or 1, sha256=sha256(data[e.file]).hexdigest()) for e in entries]
    (folder / "store" / MANIFEST).write_bytes(manifest_bytes(true))
    damaged = {entry.file for entry in WeightStore(folder / "store").check()[0]}
    for entry in true:
        with contextlib.suppress(LegsError):
            read_store(folder, [entry])
            assert entry.file not in damaged
            continue
        assert entry.file in damaged


def read_store(folder: Path, entries: Optional[List[Entry]] = None) -> None:
    store = WeightStore(folder / "store")
    store.check()
    for entry in entries or store.entries.values():
        values = store.normalised_response(entry)
        assert values.shape == (entry.height, entry.width) and values.min() >= 0 and values.max() <= 1


def read_listed(folder: Path) -> None:
    """Read a store of a damaged manifest whose checksum agrees with it, as a stranger would write it."""
    path = folder / "store" / MANIFEST
    path.write_bytes(with_checksum(path.read_bytes()))
    read_store(folder)


def with_checksum(manifest: bytes) -> bytes:
    """Return a manifest with the checksum that it has to have."""
    _, _, body = manifest.partition(b",\n")
    return b'{"checksum": "%s",\n' % sha256(body[:-2]).hexdigest().encode() + body


def read_images(folder: Path) -> None:
    for path in folder.iterdir():
        with contextlib.suppress(LegsError):
            load_training_image(View(path.name, path))


def read_points(folder: Path) -> None:
    scene = read_scene(folder)
    if scene.points is not None:
        assert np.isfinite(scene.points.xyz).all()


def show(folder: Path) -> None:
    for part in splats(read_ply(folder / "g.ply")):
        assert np.isfinite(part).all()


def patch(folder: Path) -> None:
    """Patch and undo: a file that compiled still compiles, and every byte comes back."""
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    found = plan(folder)
    for name, after in found.after.items():
        if compiles(before[name]):
            assert compiles(after), f"{name} no longer compiles"
    if write(found):
        undo(folder)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def compiles(data: bytes) -> bool:
    try:
        compile(data, "x.py", "exec", dont_inherit=True)
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return False
    return True


def read_journal(folder: Path) -> None:
    before = (folder / "train.py").read_bytes()
    try:
        undo(folder, force=True)
    except LegsError:
        assert (folder / "train.py").read_bytes() == before


def read_settings(folder: Path) -> None:
    find_config(folder, {}, [])


READERS: Dict[str, Reader] = {
    "sources": (make_checkout, ["train.py", "utils.py"], patch),
    "journal": (make_patched, [JOURNAL], read_journal),
    "store": (make_store, ["store/manifest.json", "store/*.npy"], read_store),
    "manifest": (make_store, ["store/manifest.json"], read_listed),
    "maps": (make_store, ["store/*.npy"], read_maps),
    "images": (make_images, ["a.*"], read_images),
    "colmap": (make_scene, ["sparse/0/*.bin"], read_points),
    "colmap text": (make_text_scene, ["sparse/0/*.txt"], read_points),
    "transforms": (make_transforms, ["transforms.json"], read_scene),
    "ply": (lambda folder: write_ply(folder / "g.ply", some_gaussians()), ["g.ply"], show),
    "checkpoint": (make_checkpoint, ["c.npz"], resume),
    "arrays": (make_arrays, ["which"], read_arrays),
    "comparison": (make_comparison, ["comparison.json", "legs/seed-0/row.json"], read_comparison),
    "settings": (lambda folder: void((folder / "legs.toml").write_bytes(TOML)), ["legs.toml"], read_settings),
}


def void(_: Any) -> None:
    """Drop the result of a call."""


def stop(*_: Any) -> None:
    raise TimeoutError(f"a case took more than {SECONDS} s of the processor")


class Watch:
    """The files written, renamed or deleted and the processes started outside of a case's folder; needs Python 3.8.

    numba's and Python's own caches, the user's state folder and the null device do not count.
    """

    def __init__(self, work: Path) -> None:
        self.on = False
        self.seen: Set[str] = set()
        self._inside = tuple(str(work / name) for name in ("case", "state")) + (os.devnull,)
        if hasattr(sys, "addaudithook"):
            sys.addaudithook(self._hook)

    def _hook(self, event: str, found: Tuple[Any, ...]) -> None:
        if not self.on:
            return
        writes = event == "open" and isinstance(found[2], int) and found[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
        if writes or event in ("os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.link", "os.symlink", "os.chmod"):
            named = found[: 2 if event == "os.rename" else 1]
            folders = found[len(named) :] if event in ("os.rename", "os.remove") else (-1,)
            self.seen.update(path for path in map(_place, named, folders)
                             if not path.startswith(self._inside) and "__pycache__" not in path)  # fmt: skip
        elif event == "subprocess.Popen" and os.path.basename(str(found[0])) != "git":
            self.seen.add(f"started {found[0]}")


def _place(path: Any, folder: int) -> str:
    """Return a path as a whole; its folder may be a descriptor. An open does not say which: it has none."""
    if not isinstance(path, (str, bytes, os.PathLike)):
        return os.devnull
    return os.path.join(os.readlink(f"/proc/self/fd/{folder}") if folder >= 0 else "", os.fsdecode(path))


def run_case(name: str, good: Path, work: Path, at: random.Random, watch: Watch) -> str:
    """Return the fault of a case, or nothing."""
    _, patterns, read = READERS[name]
    folder = work / "case"
    if folder.exists():
        shutil.rmtree(str(folder))
    shutil.copytree(str(good), str(folder), symlinks=True)
    files = sorted(path for pattern in patterns for path in folder.glob(pattern))
    victim = at.choice(files)
    victim.write_bytes(damage(victim.read_bytes(), at))
    watch.seen.clear()
    watch.on = True
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        read(folder)
    except LegsError as error:
        if not str(error) or "\n" in str(error).strip():
            return f"its error is no one line: {error}"
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        return "".join(traceback.format_exception(type(error), error, error.__traceback__)[-4:])
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        watch.on = False
    outside = sorted(path for path in watch.seen if os.path.isabs(path) or os.path.lexists(path))
    return f"outside of its folder: {', '.join(outside)}" if outside else ""


def cases(names: List[str], seed: int, until: float, count: int) -> Iterator[Tuple[int, str, random.Random]]:
    number = 0
    while time.monotonic() < until and number < count:
        yield number, names[number % len(names)], random.Random(f"{seed}/{number}")
        number += 1


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=1e9, help="how long; default: until --cases are done")
    parser.add_argument("--cases", type=int, help="how many; default: as many as there is time for")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--readers", nargs="+", choices=list(READERS), default=list(READERS))
    parser.add_argument("--keep", type=Path, default=Path("fuzz-failures"), help="where what fails is kept")
    args = parser.parse_args()
    if args.cases is None and args.minutes == 1e9:
        parser.error("give --minutes or --cases")
    signal.signal(signal.SIGPROF, stop)
    counts, failed = dict.fromkeys(args.readers, 0), 0
    with tempfile.TemporaryDirectory(prefix="legs-fuzz-") as place:
        work = Path(place).resolve()
        os.environ["MPLCONFIGDIR"] = str(work / "state")
        for name in args.readers:
            (work / "good" / name).mkdir(parents=True)
            READERS[name][0](work / "good" / name)
        until, watch = time.monotonic() + 60 * args.minutes, Watch(work)
        for number, name, at in cases(args.readers, args.seed, until, args.cases or sys.maxsize):
            wrong = run_case(name, work / "good" / name, work, at, watch)
            counts[name] += 1
            if wrong:
                failed += 1
                kept = args.keep / f"{name.replace(' ', '-')}-{args.seed}-{number}"
                shutil.rmtree(str(kept), ignore_errors=True)
                shutil.copytree(str(work / "case"), str(kept), symlinks=True)
                print(f"seed {args.seed}, case {number} ({name}), kept in {kept}:\n{wrong}", flush=True)
    print(f"seed {args.seed}: {sum(counts.values())} cases, {failed} failed; "
          + ", ".join(f"{name} {count}" for name, count in counts.items()))  # fmt: skip
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
