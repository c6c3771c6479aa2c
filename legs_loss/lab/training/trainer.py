"""A small 3D Gaussian Splatting trainer on the CPU, with 3DGS's optimiser and density control.

    from legs_loss.lab.training import TrainConfig, train
    result = train(read_scene("my_scene"), TrainConfig(spec="legs"), out="output/my_scene")

The same seed gives bit-identical Gaussians, whether or not the run was interrupted and resumed.
"""

from __future__ import annotations

import ctypes
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Callable, Dict, List, Mapping, NamedTuple, Optional, Tuple, Union

import numpy as np
import torch
from torch import Tensor

from legs_loss.errors import LegsError, require
from legs_loss.lab.gaussians import Gaussians
from legs_loss.lab.ply import write_ply
from legs_loss.lab.rasterizer import Rendering, rasterize
from legs_loss.lab.training.adam import Adam, position_rate
from legs_loss.lab.training.checkpoint import CHECKPOINT, alone_in, check_new, read_state, write_checkpoint, write_json
from legs_loss.lab.training.config import TrainConfig, default_threshold
from legs_loss.lab.training.dataset import (
    Dataset,
    TrainingView,
    extent,
    load_dataset,
    pinhole_camera,
    shuffled,
    split_views,
)
from legs_loss.lab.training.densify import RESET_OPACITY, Schedule, densify, prunable
from legs_loss.lab.training.metrics import mean_scores, psnr, score
from legs_loss.scenes import Camera, Scene
from legs_loss.system.ctrl_c import noted
from legs_loss.weights import Weights

_TRIM_THRESHOLD, _MMAP_MAX = -1, -4  # glibc's malloc.h
_FACTS = ("iteration", "order", "loss", "psnr", "growth", "history")  # of a run, that a checkpoint keeps as they are


class Progress(NamedTuple):
    """The progress of a training: smoothed loss and PSNR of the training views, and the number of Gaussians."""

    iteration: int
    loss: float
    psnr: float
    gaussians: int


@dataclass(frozen=True, eq=False)
class TrainingResult:
    """A finished training: the Gaussians, and what ``metrics.json`` holds."""

    gaussians: Gaussians
    metrics: Dict[str, Any]


def step_loss(prediction: Tensor, target: Tensor, weights: Weights, lambda_dssim: float) -> Tensor:
    """Return the loss of one iteration: of a rendering [3, H, W], its photograph and the weights of its pixels."""
    from legs_loss.kernels.contract import terms_of
    from legs_loss.kernels.numba_loss import BACKEND

    return weights.of_what_counts(
        BACKEND.loss(terms_of(lambda_dssim), weights.hidden(prediction, target), target, weights)
    )


def compile_step(command: str) -> None:
    """Compile what a step calls, as far as it is not kept from before: said by a command, and in nobody's time.

    Raises:
        LegsError: numba is missing.
    """
    require("a training", "cpu", "numba")
    from legs_loss.kernels.compiling import said
    from legs_loss.kernels.numba_tiles import all_tiles
    from legs_loss.lab.rasterizer import projection, projection_backward, strips
    from legs_loss.lab.training.adam_kernel import update

    calls = (projection.project, projection.find_rows, strips.render, all_tiles, strips.render_backward)
    with said(command, "20 to 100 s", (*calls, projection_backward.project_backward, update)):
        adam = Adam(Gaussians.from_points(np.eye(3) + 2.0, np.full((3, 3), 99), 1))
        view = TrainingView("", Camera(16, 16, 9.0, 9.0, 8.0, 8.0, np.eye(4)), torch.ones(3, 16, 16))
        image = _rasterize(adam.gaussians, view, TrainConfig(), 1, torch.zeros(3, 2, requires_grad=True)).image
        step_loss(image, view.image, Weights(), 0.5).backward()
        adam.step(0.0)


def draw(gaussians: Gaussians, view: TrainingView, config: TrainConfig) -> Tensor:
    """Return a finished scene's rendering of a view, [3, H, W], not clipped."""
    with torch.no_grad():
        return _rasterize(gaussians, view, config, config.sh_degree, None).image


def point_cloud(out: Path, config: TrainConfig) -> Path:
    """Return the path of a run's .ply in its output folder: 3DGS's own place."""
    return out / "point_cloud" / f"iteration_{config.iterations}" / "point_cloud.ply"


def train(
    scene: Scene,
    config: TrainConfig,
    out: Optional[Union[str, Path]] = None,
    resume: Optional[bool] = False,
    store: Optional[Path] = None,
    checkpoint_every: int = 500,
    on_progress: Optional[Callable[[Progress], None]] = None,
    caps: Optional[Mapping[int, int]] = None,
    evaluate_every: Optional[int] = None,
    stop: Optional[int] = None,
) -> TrainingResult:
    """Train 3D Gaussians on a scene.

    Args:
        scene: with pinhole cameras and points to start from.
        config: the settings.
        out: a folder for the checkpoint, ``cfg.json``, ``metrics.json`` and 3DGS's own
            ``point_cloud/iteration_N/point_cloud.ply``; None keeps everything in memory.
        resume: resume from the checkpoint in ``out``; with the same arguments the result is bit-equal to that of an
            uninterrupted run. None: where there is one.
        store: the store of the weight maps, see :func:`load_dataset`.
        checkpoint_every: iterations between checkpoints. Another one is written on Ctrl-C.
        on_progress: called every 10 iterations.
        caps: the most Gaussians that a densification may lead to, before it prunes, by its iteration; in place of
            ``config.max_gaussians``. Another run's ``metrics["growth"]`` gives this one that run's numbers: for
            experiments. A resumed run needs the same ``caps``.
        evaluate_every: score the held-out views every so many iterations into ``metrics["history"]``, outside of the
            run's time; None: only at the end.
        stop: end after this iteration of the schedule; the run goes on from its checkpoint when it is resumed.

    Raises:
        LegsError: the scene cannot be trained on, numba is missing, the checkpoint does not fit, another training
            writes to ``out``, or a run is there and ``resume`` is False.
        KeyboardInterrupt: Ctrl-C, after the checkpoint.
    """
    if not resume:
        check_trainable(scene)
    data = load_dataset(scene, config.weights, config.resolution, config.white_background, store)
    if config.shuffled:
        data = data._replace(train=shuffled(data.train, config.seed))
    folder = None if out is None else Path(out)
    if resume and folder is None:
        raise LegsError("there is nothing to resume from without an output folder")
    begun = None if resume else _TrainingState.begin(data, config, scene)
    compile_step("legs train")
    keep_freed_memory()  # the arrays of a step are as large as those of the step before
    with alone_in(folder, make=not resume):
        if folder is not None and resume is None:
            resume = (folder / CHECKPOINT).is_file()
        elif folder is not None and not resume:
            check_new(folder)
        run = begun if begun and not resume else _TrainingState.restore(data, config, Path(out or ".") / CHECKPOINT)
        run.caps, run.evaluate_every = caps, evaluate_every
        if folder is not None:
            write_json(folder / "cfg.json", config.as_dict())
            if not resume:
                run.save(folder / CHECKPOINT)
        run.go(folder, checkpoint_every, on_progress, min(stop or config.iterations, config.iterations))
        metrics = run.metrics()
        if folder is not None:
            if run.iteration == config.iterations:
                write_ply(point_cloud(folder, config), run.adam.gaussians)
            write_json(folder / "metrics.json", metrics)
        return TrainingResult(run.adam.gaussians, metrics)


def check_trainable(scene: Scene) -> None:
    """Check that a scene has what a training needs; no photograph is read.

    Raises:
        LegsError: a view without a pinhole camera, or no points to start from.
    """
    for views in split_views(scene):
        for view in views:
            pinhole_camera(scene, view)
    _points(scene)


def _points(scene: Scene) -> Tuple[np.ndarray, np.ndarray]:
    """Return a scene's points and their colours."""
    points = scene.points
    if points is None or len(points.xyz) < 2:
        raise LegsError(
            f"{scene.root}: there are no points to start from: training needs a COLMAP scene, which has them in "
            "sparse/0/points3D.bin"
        )
    return points.xyz, points.rgb


class _TrainingState:
    """The state of a training between two iterations."""

    def __init__(self, data: Dataset, config: TrainConfig, adam: Adam) -> None:
        self.data, self.config, self.adam = data, config, adam
        self.extent = extent(data.train)
        self.schedule = Schedule.of_run(config.iterations)
        self.threshold = config.densify_grad_threshold or default_threshold(data.train)
        self.iteration = 0
        self.clocks = np.zeros(2)  # seconds: on the wall, and of the processor
        self.scoring = np.zeros(2)  # the same for the history's scores, which do not count
        self.generator = torch.Generator().manual_seed(config.seed)
        self.order: List[int] = []  # the views that this round through all of them has still to show
        self.loss: Optional[float] = None
        self.psnr: Optional[float] = None
        self._forget_gradients()
        self.weights = [step_weights(view.weight, view, config) for view in data.train]
        self.caps: Optional[Mapping[int, int]] = None
        self.growth: List[List[int]] = []  # [iteration of a densification, Gaussians before it pruned]
        self.evaluate_every: Optional[int] = None
        self.history: List[Dict[str, float]] = []

    @classmethod
    def begin(cls, data: Dataset, config: TrainConfig, scene: Scene) -> _TrainingState:
        return cls(data, config, Adam(Gaussians.from_points(*_points(scene), config.sh_degree)))

    @classmethod
    def restore(cls, data: Dataset, config: TrainConfig, path: Path) -> _TrainingState:
        arrays, facts = read_state(path)
        if facts["views"] != [view.name for view in data.train]:
            raise LegsError(f"{path}: this run was made from a scene with other views")
        if TrainConfig.from_dict(facts["config"]) != config:
            raise LegsError(f"{path}: this run was made with other settings")
        run = cls(data, config, Adam.restore(arrays))
        run.clocks = np.array(facts["clocks"])
        for name in _FACTS:
            setattr(run, name, facts[name])
        run.gradient_sum = torch.from_numpy(arrays["gradient_sum"])
        run.times_seen = torch.from_numpy(arrays["times_seen"])
        run.generator.set_state(torch.from_numpy(arrays["generator"]))
        return run

    def save(self, path: Path) -> None:
        arrays = dict(
            self.adam.state(),
            gradient_sum=self.gradient_sum.numpy(),
            times_seen=self.times_seen.numpy(),
            generator=self.generator.get_state().numpy(),
        )
        facts = {
            "config": self.config.as_dict(),
            "views": [view.name for view in self.data.train],
            "clocks": self.clocks.tolist(),
            **{name: getattr(self, name) for name in _FACTS},
        }
        write_checkpoint(path, arrays, facts)

    def go(
        self,
        folder: Optional[Path],
        checkpoint_every: int,
        on_progress: Optional[Callable[[Progress], None]],
        stop: int,
    ) -> None:
        """Run to the last iteration, or to ``stop``."""
        started = _clocks() - self.clocks
        with noted() as interrupted:  # not between two dependent updates
            while self.iteration < stop:
                self.step()
                self.clocks = _clocks() - started - self.scoring
                last = self.iteration == stop
                due = last or self.iteration % 10 == 0
                if on_progress is not None and due and self.loss is not None and self.psnr is not None:
                    on_progress(Progress(self.iteration, self.loss, self.psnr, len(self.adam.gaussians)))
                if folder is not None and (last or interrupted() or self.iteration % checkpoint_every == 0):
                    self.save(folder / CHECKPOINT)
                if interrupted():
                    raise KeyboardInterrupt

    def step(self) -> None:
        """Run one iteration: draw, loss, gradient, Adam; and what the schedule asks for."""
        self.iteration += 1
        gaussians = self.adam.gaussians
        index = self._next_view()
        view = self.data.train[index]
        degree = min(self.config.sh_degree, self.iteration // self.schedule.sh_every)
        viewspace = torch.zeros(len(gaussians), 2, requires_grad=True)
        drawn = _rasterize(gaussians, view, self.config, degree, viewspace)
        weighted = self.config.weighted(self.iteration)
        weights = self.weights[index] if weighted else step_weights(None, view, self.config)
        loss = step_loss(drawn.image, view.image, weights, self.config.lambda_dssim)
        loss.backward()
        if self.iteration % 10 == 0 or self.iteration == self.config.iterations:
            self._report(float(loss.detach()), psnr(drawn.image.detach(), view.image, view.counts))
        steps = self.config.position_lr_max_steps or self.config.iterations
        seen = torch.nonzero(drawn.radii)[:, 0] if self.config.sparse_adam else None
        self.adam.step(position_rate(min(1.0, self.iteration / steps), self.extent), seen)
        if self.evaluate_every is not None and self.iteration % self.evaluate_every == 0:
            self._evaluate()  # as in 3DGS before Gaussians are added, which blurs the picture for some iterations
        if self.iteration < self.schedule.densify_until:
            assert viewspace.grad is not None
            self.gradient_sum += viewspace.grad.norm(dim=1)  # 0 where it was not seen
            self.times_seen += drawn.radii > 0
            if self.schedule.densifies(self.iteration):
                self._densify()
            if self.schedule.resets(self.iteration):
                self.adam.reset_opacity(RESET_OPACITY)

    def metrics(self) -> Dict[str, Any]:
        """Return scores over training and held-out views, and what they cost."""
        train, test = self._scores("train"), self._scores("test")
        masked = sum(view.mask is not None for view in self.data.train)
        return {
            **({"masked_views": masked} if masked else {}),
            "train": mean_scores(list(train.values())),
            "test": mean_scores(list(test.values())) if test else None,
            "gaussians": len(self.adam.gaussians),
            "densify_grad_threshold": self.threshold,
            "mean_weight": sum(weights.mean_weight() for weights in self.weights) / len(self.weights),
            "iterations": self.iteration,
            "seconds": float(self.clocks[0]),
            "processor_seconds": float(self.clocks[1]),
            "growth": self.growth,
            "history": self.history,
            "views": {"train": train, "test": test},
        }

    def _scores(self, split: str) -> Dict[str, Dict[str, float]]:
        views = self.data.train if split == "train" else self.data.test
        drawn = ((view, draw(self.adam.gaussians, view, self.config)) for view in views)
        return {view.name: score(view.hidden(image), view.image, split, view.counts) for view, image in drawn}

    def _evaluate(self) -> None:
        begun = _clocks()
        point: Dict[str, float] = {"iteration": self.iteration, "gaussians": len(self.adam.gaussians)}
        if self.psnr is not None:
            point["train_psnr"] = self.psnr
        if self.data.test:
            drawn = ((view, draw(self.adam.gaussians, view, self.config)) for view in self.data.test)
            values = [psnr(image.clamp(0.0, 1.0), view.image, view.counts) for view, image in drawn]
            point["test_psnr"] = sum(values) / len(values)
        self.history.append(point)
        self.scoring += _clocks() - begun

    def _next_view(self) -> int:
        if not self.order:
            self.order = torch.randperm(len(self.data.train), generator=self.generator).tolist()
        return self.order.pop()

    def _densify(self) -> None:
        gradient = self.gradient_sum / self.times_seen.clamp(min=1)
        cap = self.config.max_gaussians if self.caps is None else self.caps[self.iteration]
        change = densify(self.adam.gaussians, gradient, self.threshold, self.extent, self.generator, cap)
        self.growth.append([self.iteration, len(change.kept) + len(change.new)])
        self.adam.replace(change.kept, change.new)
        remaining = ~prunable(self.adam.gaussians, self.extent, self.iteration > self.schedule.reset_every)
        self.adam.keep(torch.nonzero(remaining)[:, 0])
        self._forget_gradients()

    def _forget_gradients(self) -> None:
        self.gradient_sum = torch.zeros(len(self.adam.gaussians))
        self.times_seen = torch.zeros(len(self.adam.gaussians))

    def _report(self, loss: float, decibels: float) -> None:
        self.loss = loss if self.loss is None else 0.6 * self.loss + 0.4 * loss
        self.psnr = decibels if self.psnr is None else 0.6 * self.psnr + 0.4 * decibels


def _rasterize(
    gaussians: Gaussians, view: TrainingView, config: TrainConfig, degree: int, viewspace: Optional[Tensor]
) -> Rendering:
    g = gaussians
    return rasterize(
        g.means, g.scales, g.quaternions, g.opacities, g.sh, view.camera, config.background, degree, viewspace
    )


def step_weights(weight: Optional[Tensor], view: TrainingView, config: TrainConfig) -> Weights:
    """Return what the pixels of a view count whose weight map is ``weight``; None without one."""
    scale = None if config.l1_scale == 1.0 else torch.full_like(view.image[:1], config.l1_scale)
    return Weights().times(scale).times(weight).masked(view.mask)


def _clocks() -> np.ndarray:
    return np.array([time.perf_counter(), time.process_time()])


def keep_freed_memory() -> None:
    """Have this process keep the memory that it frees for its next allocations (with glibc; else nothing changes).

    Otherwise each array of more than some megabytes is mapped anew, and the kernel clears its pages one by one.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError, TypeError):
        return
    mallopt(_MMAP_MAX, 0)
    mallopt(_TRIM_THRESHOLD, -1)
