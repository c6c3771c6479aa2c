"""Compute the weight maps of scenes once, for every later training.

SCENE is a folder with a COLMAP model, with transforms.json, or just with images; a glob pattern of such folders; or a
.txt file with one of these per line. The maps go to SCENE/legs_weights, where a script that trains on SCENE finds them.
Give -r, -w and --images as for the training: a map is used only for exactly the image that it was made from. With
--scheduler the workers of a dask cluster compute the scenes, which must have the same paths on all of them.

--masks and --weights take maps of your own: a folder of PNG or other images, gray, named as their photographs (0001.png
or 0001.jpg.png), or one image for all; averaged to the training's size. In a mask white counts and black does not.
"""

from __future__ import annotations

import argparse
import os
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, Dict, Iterable, Tuple

from legs_loss.cli.shared.scene_arguments import add_images, add_resolution, say_notes, say_skipped
from legs_loss.system.machine import cores
from legs_loss.system.terminal import say

if TYPE_CHECKING:
    from legs_loss.precompute import Report
    from legs_loss.precompute.many_scenes import SceneTask

HELP = "compute the weight maps of scenes once, for every later training"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    from legs_loss.spec import PRESETS

    what = "a COLMAP scene, a scene with transforms.json or a folder of images; a glob; a .txt file of these"
    parser.add_argument("scene", metavar="SCENE", nargs="+", help=what)
    add_images(parser)
    add_resolution(parser, default=-1)
    parser.add_argument("-w", "--white_background", action="store_true", help="as in 3DGS: lay alpha over white")
    parser.add_argument("--preset", choices=PRESETS, default="legs", help="whose operator to use; default: legs")
    what = "a folder of masks, one for all, the photographs' own alpha, or those that transforms.json names"
    parser.add_argument("--masks", metavar="DIR|FILE|alpha|mask_path", help=what)
    parser.add_argument("--weights", metavar="DIR", help="a folder of weights, .npy too, that multiply the preset's")
    what = "of --weights: what white stands for; default: 1"
    parser.add_argument("--weight_scale", type=float, default=1.0, metavar="W", help=what)
    what = "the store's folder, or for several scenes the folder of their stores"
    parser.add_argument("--out", metavar="DIR", help=f"{what}; default: SCENE/legs_weights, where a training finds it")
    what = "of a dask cluster that shares the file system; a scene is a task"
    parser.add_argument("--scheduler", metavar="ADDRESS", help=what)
    what = f"processes per scene; default: one per core ({cores()}), with --scheduler 1"
    parser.add_argument("--workers", type=int, metavar="N", help=what)


def run(args: argparse.Namespace) -> int:
    """Write the stores; 1 when a photograph was skipped, or one of several scenes failed."""
    from tqdm import tqdm

    from legs_loss.errors import LegsError
    from legs_loss.precompute.executors import outcomes
    from legs_loss.precompute.many_scenes import precompute_scene

    tasks = _tasks(args)
    failed = 0
    views: Dict[str, Tuple[int, int]] = {}  # of each scene those that are done, and all
    # With a delay, nothing is shown before the first view or for earlier failures.
    with tqdm(total=0, desc="weight maps", unit="view", delay=0.001) as bar:

        def listen(message: Dict[str, Any]) -> None:
            """Handle a task's message; a restarted task replaces its earlier messages."""
            views[message["scene"]] = message["done"], message["of"]
            bar.total = sum(of for _, of in views.values())
            bar.update(sum(done for done, _ in views.values()) - bar.n)

        for ended, (task, done) in enumerate(outcomes(precompute_scene, tasks, listen, scheduler=args.scheduler), 1):
            with bar.external_write_mode():
                if isinstance(done, LegsError) and len(tasks) == 1:
                    raise done
                if isinstance(done, LegsError):
                    say(f"legs: error: {task.scene}: {done}", sys.stderr)
                    failed += 1
                else:
                    failed += _say(tasks[task], done)
            if len(tasks) > 1:
                bar.set_description(f"weight maps, {ended} of {len(tasks)} scenes")
    if args.out is not None:
        _say_where(tasks)
    return 1 if failed else 0


def _tasks(args: argparse.Namespace) -> Dict[SceneTask, Path]:
    """Check the arguments before anything is computed; return the tasks, and their stores as they were named."""
    from legs_loss.cli.shared.checks import check_resolution, check_writable
    from legs_loss.errors import LegsError
    from legs_loss.precompute.many_scenes import SceneTask, find_scenes, stores_of
    from legs_loss.precompute.user_maps import UserMaps
    from legs_loss.scenes import from_anywhere, read_scene

    workers = args.workers if args.workers is not None else cores() if args.scheduler is None else 1
    if workers < 1:
        raise LegsError(f"--workers must be at least 1, got {workers}")
    scenes = find_scenes(args.scene)
    stores = stores_of(scenes, args.out)
    for scene in scenes if args.out is None else ():
        _refuse_photographs_of_a_scene(scene)
    try:
        views = read_scene(scenes[0], args.images).views
    except LegsError:
        if len(scenes) == 1:
            raise
        views = ()
    check_resolution(args.resolution, views)
    for store in stores if args.scheduler is None else ():
        check_writable(store)
    if args.out is not None:
        stores[0].parent.mkdir(parents=True, exist_ok=True)

    settings = args.preset, args.resolution, args.white_background, workers
    tasks = {}
    for scene, store in zip(scenes, stores):
        images, masks, weights = (from_anywhere(scene, named) for named in (args.images, args.masks, args.weights))
        root, out = Path(os.path.abspath(str(scene))), Path(os.path.abspath(str(store)))
        tasks[SceneTask(root, out, images, UserMaps(masks, weights, args.weight_scale), settings)] = store
    return tasks


def _refuse_photographs_of_a_scene(folder: Path) -> None:
    """Raise a LegsError for SCENE/images: no training that is given SCENE would find the maps in there."""
    from legs_loss.errors import LegsError
    from legs_loss.scenes.transforms import find_transforms

    def is_scene(path: Path) -> bool:
        return (path / "sparse").is_dir() or bool(find_transforms(path))

    scene = folder.absolute().parent
    if folder.is_dir() and is_scene(scene) and not is_scene(folder):
        other = "" if folder.name == "images" else f" --images {shlex.quote(folder.name)}"
        raise LegsError(
            f"{folder} has the photographs of the scene {scene}: no training of it looks for maps in there; give "
            f"the scene: legs precompute {shlex.quote(str(scene))}{other}"
        )


def _say(store: Path, report: Report) -> int:
    """Print the result of a scene; return 1 if any of it failed."""
    from legs_loss.precompute.sharpness import unsharp_views
    from legs_loss.store import MANIFEST, WeightStore

    say_skipped(report.skipped)
    say_notes(report.notes)
    unsharp = unsharp_views(WeightStore(report.store)) if (report.store / MANIFEST).is_file() else []
    if unsharp:
        what = "probably out of focus, moved or noisy compared with the others; each map is normalised by its own range"
        say_notes([f"{', '.join(unsharp)}: {what}, so such photographs get larger weights"])
    for kind, count in report.user_maps.items():
        say(f"{store}: {count} {kind if kind.endswith('s') else kind + 's'} of your own")
    say(f"{store}: {len(report.made)} made, {len(report.kept)} up to date, {len(report.skipped)} skipped")
    if report.made and not (report.store / MANIFEST).is_file():
        say(
            f"legs: error: a worker wrote {report.store}, which is not visible here: the file system is not shared",
            sys.stderr,
        )
        return 1
    return 1 if report.skipped else 0


def _say_where(tasks: Iterable[SceneTask]) -> None:
    from legs_loss.config import STORE_FOLDER

    away = [task for task in tasks if task.store != task.scene / STORE_FOLDER]
    if away:
        where, store = away[0].scene / STORE_FOLDER, shlex.quote(str(away[0].store))
        how = f"name the store with LEGS_STORE={store}, or as `store` in legs.toml"
        say_notes([f"a training that is given the scene looks in {where}, not there: {how}"])
