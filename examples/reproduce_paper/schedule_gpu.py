"""Train arms by 3DGS's own schedule of 30,000 iterations on a GPU, and score them at milestones.

    python -m examples.reproduce_paper.schedule_gpu SCENE OUT --arms 3dgs legs 3dgs@legs --until 7000   # at the root

The density control, the rates, the order of the views and the scores are those of the package's trainer, schedule.py;
the pictures and their gradients are drawn by 3DGS's own CUDA rasterizer (its branch 3dgs_accel), the loss is computed
by the package's CUDA kernels. The rasterizer adds in no fixed order: a run does not repeat bit by bit. An arm X@Y may
run beside Y, whose numbers of Gaussians it reads as they come. An arm that another equals up to some iteration
(`legs:until=15000` and `legs`, `legs:from=15000` and `3dgs`) goes on from that one's state there, if that stands before
it among the arms, and has its own milestones from there on. OUT/seed-N/ARM/metrics-M.json has the scores.
"""

from __future__ import annotations

import json
import time
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any, Dict, List, NamedTuple, Optional

import torch
from torch import Tensor

from examples.reproduce_paper.schedule import arguments, settings
from legs_loss import legs_loss, ssim
from legs_loss.lab.experiments.arms import ArmSpec, parse_arm, parse_arms
from legs_loss.lab.gaussians import Gaussians
from legs_loss.lab.training import TrainConfig
from legs_loss.lab.training.adam import COLOUR_RATE, RATES, position_rate
from legs_loss.lab.training.dataset import TrainingView, extent, load_dataset
from legs_loss.lab.training.densify import RESET_OPACITY, Schedule, densify, prunable
from legs_loss.lab.training.metrics import mean_scores, psnr, strongest
from legs_loss.lab.training.perceptual import has_lpips, lpips
from legs_loss.scenes import Scene, read_scene
from legs_loss.system.files import write_whole

try:
    from diff_gaussian_rasterization import GaussianRasterizationSettings, GaussianRasterizer
except ImportError as error:
    raise SystemExit(
        f"schedule_gpu draws with 3DGS's CUDA rasterizer, branch 3dgs_accel: install it first ({error})"
    ) from None

NEAR, FAR = 0.01, 100.0  # 3DGS's clipping planes
PATIENCE = 600.0  # seconds to wait for another arm's numbers


def main() -> None:
    """Train what is missing."""
    args = arguments(str(__doc__))
    torch.set_default_device("cuda")
    folder = args.out / f"seed-{args.seed}"
    milestones = [at for at in args.milestones if at <= args.until]
    arms = parse_arms(args.arms)
    scene = read_scene(args.scene)
    runs = [
        Run(scene, arm, settings(arm, args), folder)
        for arm in arms
        if not (folder / arm.folder / f"metrics-{milestones[-1]}.json").is_file()
    ]
    for run in runs:
        for other in runs:
            at = other.equals_until(run)
            if at is not None:
                run.go([one for one in milestones if one <= at])
                other.take(run)
        run.go(milestones)


class Shown(NamedTuple):
    """A view on the GPU; ``strong``: the pixels with the strongest responses."""

    name: str
    image: Tensor
    weight: Tensor
    strong: Tensor
    settings: GaussianRasterizationSettings


class Optimiser:
    """The parameters, by name as 3DGS holds them, and torch's fused Adam over them."""

    def __init__(self, gaussians: Gaussians) -> None:
        self._set(_parts(gaussians), None, {})

    def _set(self, values: Dict[str, Tensor], steps: Optional[Tensor], moments: Dict[str, List[Tensor]]) -> None:
        self.values = {name: value.detach().contiguous().requires_grad_(True) for name, value in values.items()}
        rates = {**RATES, "means": 0.0, "dc": COLOUR_RATE, "rest": COLOUR_RATE / 20}
        groups = [{"params": [value], "lr": rates[name]} for name, value in self.values.items()]
        self.adam: torch.optim.Adam = torch.optim.Adam(groups, eps=1e-15, fused=True)
        if steps is not None:
            for name, value in self.values.items():
                first, second = moments[name]
                self.adam.state[value] = {"step": steps.clone(), "exp_avg": first, "exp_avg_sq": second}

    @property
    def gaussians(self) -> Gaussians:
        """Return the Gaussians, as the density control takes them."""
        v = {name: value.detach() for name, value in self.values.items()}
        return Gaussians(
            v["means"], v["log_scales"], v["quaternions"], v["opacity_logits"], torch.cat([v["dc"], v["rest"]], 1)
        )

    def step(self, rate: float) -> None:
        """Update every parameter from its gradient, and drop the gradients."""
        self.adam.param_groups[0]["lr"] = rate
        self.adam.step()
        self.adam.zero_grad(set_to_none=True)

    def replace(self, kept: Tensor, new: Optional[Gaussians] = None) -> None:
        """Keep the Gaussians of index ``kept`` with their moments, and append ``new`` ones, whose moments are 0."""
        added = {name: value[:0] for name, value in self.values.items()} if new is None else _parts(new)
        states = {name: self.adam.state[value] for name, value in self.values.items()}
        moments = {
            name: [torch.cat([state[key][kept], torch.zeros_like(added[name])]) for key in ("exp_avg", "exp_avg_sq")]
            for name, state in states.items()
        }
        values = {name: torch.cat([value.detach()[kept], added[name].detach()]) for name, value in self.values.items()}
        self._set(values, states["means"]["step"], moments)

    def reset_opacity(self) -> None:
        """Lower every opacity to 3DGS's ceiling at most, and forget its moments."""
        logits = self.values["opacity_logits"]
        with torch.no_grad():
            logits.clamp_(max=float(torch.logit(torch.tensor(RESET_OPACITY))))
        for key in ("exp_avg", "exp_avg_sq"):
            self.adam.state[logits][key].zero_()


def _parts(gaussians: Gaussians) -> Dict[str, Tensor]:
    g = gaussians
    return {
        "means": g.means,
        "log_scales": g.log_scales,
        "quaternions": g.quaternions,
        "opacity_logits": g.opacity_logits,
        "dc": g.sh[:, :1],
        "rest": g.sh[:, 1:],
    }


class Run:
    """The training of an arm; the steps are those of the package's trainer."""

    def __init__(self, scene: Scene, arm: ArmSpec, config: TrainConfig, folder: Path) -> None:
        with torch.device("cpu"):
            data = load_dataset(scene, config.weights, config.resolution)
            assert scene.points is not None
            points = Gaussians.from_points(scene.points.xyz, scene.points.rgb, config.sh_degree)
        self.arm, self.config, self.folder = arm, config, folder / arm.folder
        self.leader = None if arm.at is None else folder / parse_arm(arm.at).folder / "growth.json"
        self.views = {"train": [_shown(view) for view in data.train], "test": [_shown(view) for view in data.test]}
        self.extent = extent(data.train)
        self.schedule = Schedule.of_run(config.iterations)
        self.order: List[int] = []
        self.orders = torch.Generator("cpu").manual_seed(config.seed)
        self.places = torch.Generator("cuda").manual_seed(config.seed)
        self.adam = Optimiser(Gaussians(*(value.cuda() for value in vars(points).values())))
        self.growth: List[List[int]] = []
        self.seconds = 0.0
        self.iteration = 0
        self._forget_gradients()
        self.folder.mkdir(parents=True, exist_ok=True)

    def equals_until(self, other: Run) -> Optional[int]:
        """Return to which iteration this arm's training is that of another one without a window; None: it is another's.

        Only of those that have not begun.
        """
        own = self.config
        if self.iteration or self.leader is not None:
            return None
        for at, plain in (
            (own.weights_until, replace(own, weights_until=None)),
            (own.weights_from, replace(own, weights_from=None, spec="3dgs")),
        ):
            if at is not None and plain == other.config:
                return at
        return None

    def take(self, other: Run) -> None:
        """Go on from the state of another run."""
        self.adam = copy(other.adam)
        self.adam.replace(torch.arange(len(self.adam.values["means"])))  # a copy, with copies of the moments
        self.order, self.growth = list(other.order), list(other.growth)
        self.orders.set_state(other.orders.get_state())
        self.places.set_state(other.places.get_state())
        self.gradient_sum, self.times_seen = other.gradient_sum.clone(), other.times_seen.clone()
        self.iteration, self.seconds = other.iteration, other.seconds

    def go(self, milestones: List[int]) -> None:
        """Train on to the last milestone, and write the scores of each that is ahead."""
        due = {at if at == self.config.iterations else at - 1: at for at in milestones}
        started = time.perf_counter()
        for iteration in range(self.iteration + 1, max(due, default=0) + 1):
            self.step(iteration)
            self.iteration = iteration
            if iteration in due:
                torch.cuda.synchronize()
                self.seconds += time.perf_counter() - started
                metrics = self.metrics(iteration)
                path = self.folder / f"metrics-{due[iteration]}.json"
                write_whole(path, json.dumps(metrics).encode())
                print(
                    due[iteration], self.arm.name, metrics["train"], metrics["test"], metrics["gaussians"], flush=True
                )
                started = time.perf_counter()

    def step(self, iteration: int) -> None:
        """Run one iteration: draw, loss, gradient, Adam; and what the schedule asks for."""
        if not self.order:
            self.order = torch.randperm(len(self.views["train"]), generator=self.orders, device="cpu").tolist()
        view = self.views["train"][self.order.pop()]
        degree = min(self.config.sh_degree, iteration // self.schedule.sh_every)
        viewspace = torch.zeros_like(self.adam.values["means"], requires_grad=True)
        image, radii = self.draw(view, degree, viewspace)
        weight = view.weight if self.config.weighted(iteration) else torch.ones_like(view.weight)
        legs_loss(image, view.image, weight=weight, lambda_dssim=self.config.lambda_dssim).backward()
        steps = self.config.position_lr_max_steps or self.config.iterations
        self.adam.step(position_rate(min(1.0, iteration / steps), self.extent))
        if iteration < self.schedule.densify_until:
            assert viewspace.grad is not None
            self.gradient_sum += viewspace.grad[:, :2].norm(dim=1)  # 0 where it was not seen
            self.times_seen += radii > 0
            if self.schedule.densifies(iteration):
                self._densify(iteration)
            if self.schedule.resets(iteration):
                self.adam.reset_opacity()

    def draw(self, view: Shown, degree: int, viewspace: Tensor) -> Any:
        """Return the rendering [3, H, W] of a view, and the radii [N]."""
        v = self.adam.values
        found = GaussianRasterizer(view.settings._replace(sh_degree=degree))(
            means3D=v["means"],
            means2D=viewspace,
            opacities=torch.sigmoid(v["opacity_logits"]),
            dc=v["dc"],
            shs=v["rest"],
            scales=torch.exp(v["log_scales"]),
            rotations=torch.nn.functional.normalize(v["quaternions"]),
        )
        return found[:2]

    def metrics(self, iteration: int) -> Dict[str, Any]:
        """Return scores over training and held-out views, as the package's trainer writes them."""
        train, test = ({view.name: self._score(view) for view in self.views[split]} for split in ("train", "test"))
        return {
            "train": mean_scores(list(train.values())),
            "test": mean_scores(list(test.values())),
            "gaussians": len(self.adam.values["means"]),
            "mean_weight": sum(float(view.weight.mean()) for view in self.views["train"]) / len(self.views["train"]),
            "iterations": iteration,
            "seconds": self.seconds,
            "growth": self.growth,
            "gpu": torch.cuda.get_device_name(),
            "views": {"train": train, "test": test},
        }

    def _score(self, view: Shown) -> Dict[str, float]:
        with torch.no_grad():
            image, _ = self.draw(view, self.config.sh_degree, torch.zeros_like(self.adam.values["means"]))
            image = image.clamp(0.0, 1.0)
            perceptual = {"lpips": lpips(image, view.image)} if has_lpips() else {}
            return {
                **perceptual,
                "psnr": psnr(image, view.image),
                "ssim": float(ssim(image, view.image)),
                "psnr_strong": psnr(image, view.image, view.strong),
                "psnr_rest": psnr(image, view.image, ~view.strong),
            }

    def _densify(self, iteration: int) -> None:
        gradient = self.gradient_sum / self.times_seen.clamp(min=1)
        cap = None if self.leader is None else _number(self.leader, iteration)
        threshold = self.config.densify_grad_threshold
        assert threshold is not None
        change = densify(self.adam.gaussians, gradient, threshold, self.extent, self.places, cap)
        self.growth.append([iteration, len(change.kept) + len(change.new)])
        write_whole(self.folder / "growth.json", json.dumps(self.growth).encode())
        self.adam.replace(change.kept, change.new)
        remaining = ~prunable(self.adam.gaussians, self.extent, iteration > self.schedule.reset_every)
        self.adam.replace(torch.nonzero(remaining)[:, 0])
        self._forget_gradients()

    def _forget_gradients(self) -> None:
        self.gradient_sum = torch.zeros(len(self.adam.values["means"]))
        self.times_seen = torch.zeros(len(self.adam.values["means"]))


def _shown(view: TrainingView) -> Shown:
    """Put a view on the GPU, with 3DGS's settings of its rasterizer; the principal point is where the camera says."""
    camera, (height, width) = view.camera, view.image.shape[1:]
    to_camera = torch.as_tensor(camera.world_to_camera, dtype=torch.float32, device="cpu")
    projection = torch.zeros(4, 4, device="cpu")
    projection[0, 0], projection[1, 1] = 2 * camera.fx / width, 2 * camera.fy / height
    projection[0, 2], projection[1, 2] = 2 * camera.cx / width - 1, 2 * camera.cy / height - 1
    projection[2, 2], projection[2, 3], projection[3, 2] = FAR / (FAR - NEAR), -FAR * NEAR / (FAR - NEAR), 1.0
    settings: Dict[str, Any] = {
        "image_height": height,
        "image_width": width,
        "tanfovx": width / (2 * camera.fx),
        "tanfovy": height / (2 * camera.fy),
        "bg": torch.zeros(3),
        "scale_modifier": 1.0,
        "viewmatrix": to_camera.T.contiguous().cuda(),
        "projmatrix": (projection @ to_camera).T.contiguous().cuda(),
        "sh_degree": 0,
        "campos": torch.linalg.inv(to_camera)[:3, 3].cuda(),
        "prefiltered": False,
        "debug": False,
        "antialiasing": False,
        "pixel_weights": None,  # of the rasterizer of Taming 3DGS
    }
    weight = torch.ones(1, height, width) if view.weight is None else view.weight.cuda()
    with torch.device("cpu"):
        strong = strongest(view.image)
    known = {name: settings[name] for name in GaussianRasterizationSettings._fields if name in settings}
    return Shown(view.name, view.image.cuda(), weight, strong.cuda(), GaussianRasterizationSettings(**known))


def _number(path: Path, iteration: int) -> int:
    """Return another run's number of Gaussians at a densification; wait until it is there."""
    began = time.monotonic()
    while time.monotonic() - began < PATIENCE:
        found = dict(json.loads(path.read_text(encoding="utf-8"))) if path.is_file() else {}
        if iteration in found:
            return int(found[iteration])
        time.sleep(0.02)
    raise SystemExit(f"{path} has no number for iteration {iteration}: train that arm first, or beside this one")


if __name__ == "__main__":
    main()
