"""Scene -> store: the normalised response of every photograph, made once for every later training.

Views are shared out to processes, each with one photograph in memory at a time; the response is computed in strips of
rows. What is finished is in the store within about a second, so a run that is interrupted or killed goes on where it
was. A view is up to date, and left alone, while its photograph's file has the size and time of change that were
recorded, its map's checksum holds, and size, operator and background are those asked for.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any, Callable, Dict, Generator, Iterator, List, NamedTuple, Optional, Sequence, Tuple, Union

import numpy as np
import torch

from legs_loss.config import STORE_FOLDER
from legs_loss.ctrl_c import kept_from_children
from legs_loss.errors import LegsError
from legs_loss.kernels.backends import backend_for
from legs_loss.operators import OPERATORS
from legs_loss.origin import note_scene
from legs_loss.response import response
from legs_loss.scenes import Scene, View, image_size, image_tensor, load_training_image, training_size
from legs_loss.scenes.images import resized_pixels, row_strips
from legs_loss.spec import Spec, WeightSpec, as_spec
from legs_loss.store import Entry, StoreWriter, fingerprint, is_intact, stage

__all__ = ["Report", "normalised_map", "precompute"]

_COMMIT_SECONDS = 1.0
_PATIENCE = 5.0  # seconds; a process that is killed leaves numba's semaphore behind, and Python warns
# The memory of a photograph of up to 16 megapixels in one piece, and kept for the next one.
_PILLOW = {"PILLOW_BLOCK_SIZE": "64m", "PILLOW_BLOCKS_MAX": "2"}
_WORTH_COMPILING = 1 << 20  # values of a photograph; loading numba takes longer than torch does for less


@dataclass
class Report:
    """What :func:`precompute` did, by the names of views: maps made, maps kept, and views skipped with the reason."""

    store: Path
    made: List[str] = field(default_factory=list)
    kept: List[str] = field(default_factory=list)
    skipped: Dict[str, str] = field(default_factory=dict)


def precompute(
    scene: Scene,
    out: Union[str, Path, None] = None,
    spec: Spec = "legs",
    resolution: int = -1,
    white_background: bool = False,
    workers: int = 1,
    progress: bool = False,
    on_progress: Optional[Callable[[int, int], None]] = None,
) -> Report:
    """Write the normalised response of every view of a scene to a store.

    Args:
        scene: from :func:`~legs_loss.scenes.read_scene`.
        out: the store's folder, ``legs_weights`` in the scene by default, where a training script finds it by itself.
            Maps already there are kept: one store holds many sizes and operators.
        spec: its operator, p and eps are used; every curve and beta can be made from the result.
        resolution: 3DGS's ``-r``, as the training will have it.
        white_background: 3DGS's ``-w``, likewise.
        workers: processes; 1 computes in this one. With more, a script needs its ``if __name__ == "__main__"``.
        progress: show a bar on stderr.
        on_progress: called after each view with the number of views that are done, and of all.

    Returns:
        What was made, kept and skipped. A photograph that cannot be read is skipped, not raised.

    Raises:
        LegsError: the store cannot be written or is damaged; bad settings.
    """
    from tqdm import tqdm

    own = scene.root / STORE_FOLDER
    out = own if out is None else Path(out)
    if out.is_symlink() and os.path.abspath(str(out)) == os.path.abspath(str(own)):  # the scene's, not the user's
        raise LegsError(f"{out} is a link, which is not followed: name the folder behind it with --out")
    spec = as_spec(spec)
    training_size(1 << 20, 1 << 20, resolution)  # a bad resolution is one error, not one a view
    report = Report(out)
    with StoreWriter(out) as writer:
        job = _Job(spec, resolution, white_background, out, writer.staging)
        known: Dict[str, List[Entry]] = {}
        for entry in writer.entries():
            known.setdefault(entry.view, []).append(entry)
        views = {view.name: view for view in scene.views}
        tasks = [_Task(view, known.get(name, [])) for name, view in views.items()]
        results = _in_processes(job, tasks, workers) if workers > 1 else (_make(job, task) for task in tasks)
        staged: List[Entry] = []
        due = time.monotonic()  # the first at once, so that there is a store
        with closing(results):
            try:
                for result in tqdm(results, "weight maps", len(tasks), unit="view", disable=not progress):
                    if result.unwritable is not None:
                        raise LegsError(f"cannot write to {out}: {result.unwritable}")
                    if result.problem is not None:
                        report.skipped[result.view] = result.problem
                    elif result.entry is None:
                        report.kept.append(result.view)
                    else:
                        report.made.append(result.view)
                        staged.append(result.entry)
                    if on_progress is not None:
                        on_progress(len(report.made) + len(report.kept) + len(report.skipped), len(tasks))
                    if staged and time.monotonic() >= due:
                        _commit(writer, staged)
                        due = time.monotonic() + _COMMIT_SECONDS
            finally:
                _commit(writer, staged)
    if out.resolve().parent != scene.root.resolve():
        note_scene(out, scene)
    return report


def normalised_map(image: np.ndarray, spec: WeightSpec) -> np.ndarray:
    """Return E^ of a photograph uint8 or uint16 [H, W, C] as float16 [H, W], with one strip's temporaries at a time."""
    height, width = image.shape[:2]
    strength = _strength(image, spec)
    low, high = strength.amin(), strength.amax()
    normalised = np.empty((height, width), np.float16)  # numpy asks for large pages; torch does not
    for rows in row_strips(height, width):  # in place: what is allocated anew has to be mapped anew
        torch.from_numpy(normalised[rows]).copy_(strength[rows].sub_(low).div_(high - low + spec.eps))
    return normalised


def _strength(image: np.ndarray, spec: WeightSpec) -> torch.Tensor:
    """Return E of a photograph uint8 or uint16 [H, W, C] as float32 [H, W]."""
    if _compiles(image.size):
        from legs_loss.kernels.numba_response import photograph_response, supports_response

        if supports_response(spec):
            return torch.from_numpy(photograph_response(image, spec))
    height, width = image.shape[:2]
    reach = OPERATORS[spec.operator].reach
    strength = torch.from_numpy(np.empty((height, width), np.float32))
    for rows in row_strips(height, width):
        # Rows that the operator reaches; at the photograph's own border it reflects.
        above, below = max(rows.start - reach, 0), min(rows.stop + reach, height)
        strip = response(image_tensor(image[above:below]), spec.operator, spec.p)
        strength[rows] = strip[0, rows.start - above : rows.stop - above]
    return strength


def _resized_pixels(image: Any, size: Tuple[int, int]) -> np.ndarray:
    """Return what :func:`resized_pixels` returns, by compiled code where that is worth it."""
    width, height = image.size
    shrinks = 8 <= size[0] < width and size[1] <= height
    if image.mode == "RGB" and shrinks and _compiles(3 * width * height):
        from legs_loss.kernels.numba_resize import resized_as

        return resized_as(resized_pixels, image, size)
    return resized_pixels(image, size)


def _compiles(values: int) -> bool:
    """Whether numba is there, and worth loading for so many values of a photograph."""
    return values >= _WORTH_COMPILING and backend_for(torch.device("cpu")) == "numba"


class _Job(NamedTuple):
    spec: WeightSpec
    resolution: int
    white_background: bool
    store: Path
    staging: Path


class _Task(NamedTuple):
    view: View
    known: Sequence[Entry]  # what the store has of this view


class _Result(NamedTuple):
    """Of one view: a staged entry, or a problem, or neither where the store's map is up to date.

    ``problem`` is the photograph's and costs the view; ``unwritable`` is the store's and ends the run.
    """

    view: str
    entry: Optional[Entry] = None
    problem: Optional[str] = None
    unwritable: Optional[str] = None


def _make(job: _Job, task: _Task) -> _Result:
    view = task.view
    try:
        source = os.stat(str(view.path))
        width, height = training_size(*image_size(view.path), job.resolution)
        wanted: Dict[str, Any] = {
            "view": view.name,
            "width": width,
            "height": height,
            "operator": job.spec.operator,
            "p": job.spec.p,
            "eps": job.spec.eps,
            "background": ("white" if job.white_background else "black") if view.composited else None,
            "source_bytes": source.st_size,
            "source_mtime_ns": source.st_mtime_ns,
        }
        if any(wanted.items() <= vars(entry).items() and is_intact(job.store, entry) for entry in task.known):
            return _Result(view.name)
        image = load_training_image(view, job.resolution, job.white_background, _resized_pixels)
        entry, made = Entry(fingerprint=fingerprint(image), **wanted), normalised_map(image, job.spec)
        try:
            return _Result(view.name, stage(job.staging, entry, made))
        except OSError as error:  # a full disk, a folder that went away: no later view fares better
            return _Result(view.name, unwritable=error.strerror or str(error))
    except LegsError as error:
        return _Result(view.name, problem=str(error))
    except (OSError, MemoryError) as error:
        return _Result(view.name, problem=f"{view.path}: {error or 'not enough memory'}")


def _in_processes(job: _Job, tasks: Sequence[_Task], workers: int) -> Generator[_Result, None, None]:
    """Yield the results of worker processes, in the order they come.

    Each worker has one task at a time and a pipe of its own: a worker that dies costs one view, and when this process
    dies, the workers find their pipes closed and end.
    """
    waiting = list(reversed(tasks))
    crew: Dict[Any, _Worker] = {}  # by this side's end of their pipes

    def give(worker: _Worker) -> None:
        worker.task = waiting.pop()
        crew[worker.connection] = worker
        with suppress(OSError):  # it died; its pipe will say so
            worker.connection.send(worker.task)

    try:
        for _ in range(min(workers, len(tasks))):
            give(_Worker(job))
        while crew:
            for connection in wait(list(crew)):
                worker = crew.pop(connection)
                try:
                    result = worker.connection.recv()
                    if result is None:  # it compiled, see `_work`
                        waiting.append(worker.task)
                        worker.end(_PATIENCE)
                        give(_Worker(job, compiles=False))
                        continue
                except (EOFError, OSError):
                    reason = f"{worker.task.view.path}: the process that read it was killed (out of memory?)"
                    result = _Result(worker.task.view.name, problem=reason)
                    worker.end()
                    worker = _Worker(job) if waiting else worker
                if waiting:
                    give(worker)
                else:
                    worker.end(_PATIENCE)
                yield result
    finally:
        for worker in crew.values():
            worker.end()


class _Worker:
    """A process that makes maps, and this side's end of its pipe."""

    task: _Task

    def __init__(self, job: _Job, compiles: bool = True) -> None:
        context = multiprocessing.get_context("spawn")  # forked, it would inherit locks and threads
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=_work, args=(theirs, job, compiles), daemon=True)
        with kept_from_children(), _kept_blocks():
            self.process.start()
        theirs.close()

    def end(self, patience: float = 0.0) -> None:
        """Close its pipe, at which it ends by itself once it is idle; after some seconds of patience it is killed."""
        self.connection.close()
        self.process.join(patience)
        self.process.terminate()
        self.process.join()


@contextmanager
def _kept_blocks() -> Iterator[None]:
    """Let Pillow, in processes started meanwhile, keep the memory of a photograph for the next.

    Mapping it anew took a quarter of the decoding. What the user has set stays.
    """
    if any(name in os.environ for name in _PILLOW):
        yield
        return
    os.environ.update(_PILLOW)
    try:
        yield
    finally:
        for name in _PILLOW:
            del os.environ[name]


def _work(connection: Any, job: _Job, compiles: bool) -> None:
    """Make maps; first, where the first of them takes compiled code that has to be compiled, only that.

    The compiler keeps nearly 200 MB to itself, so None is sent then: another process is to load what this one compiled.
    """
    torch.set_num_threads(1)
    try:
        task = connection.recv()
        if compiles and _is_large(task.view.path) and _compiled_anew(job.spec):
            connection.send(None)
            return
        while True:
            connection.send(_make(job, task))
            task = connection.recv()
    except (EOFError, OSError):  # the parent has ended
        pass


def _is_large(path: Path) -> bool:
    with suppress(LegsError, OSError):
        width, height = image_size(path)
        return _compiles(3 * width * height)
    return False


def _compiled_anew(spec: WeightSpec) -> bool:
    """Load the compiled code by a small picture, and say whether any of it was not on disk yet."""
    from numba.core import event
    from PIL import Image

    from legs_loss.kernels.numba_resize import resized
    from legs_loss.kernels.numba_response import photograph_response, supports_response

    with event.install_recorder("numba:compile") as compiled:
        small = resized(Image.new("RGB", (64, 64)), (32, 32))
        if supports_response(spec):
            photograph_response(small, spec)
    return bool(compiled.buffer)


def _commit(writer: StoreWriter, staged: List[Entry]) -> None:
    """Commit what is staged, and empty the list; an interrupt waits until that is done."""
    interrupts: List[int] = []
    with _on_interrupt(lambda number, _: interrupts.append(number)):
        batch, staged[:] = list(staged), []
        if batch:
            writer.commit(batch)
    if interrupts:
        raise KeyboardInterrupt


@contextmanager
def _on_interrupt(handler: Any) -> Iterator[None]:
    """Handle SIGINT otherwise for a while, where it is handled at all: in the main thread, if it is not ignored."""
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or before is signal.SIG_IGN:
        yield
        return
    signal.signal(signal.SIGINT, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
