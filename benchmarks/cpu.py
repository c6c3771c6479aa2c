"""The cost of a stand-in over the reference rasterizer called directly: same Gaussians, same image, side by side.

    PYTHONPATH=.:adapters python benchmarks/cpu.py --threads 1

An iteration is what a training step does with the picture: draw, L1 and D-SSIM of it, backward, and Adam over the
Gaussians' raw parameters, from their activations on. Adam is torch's, but for FasterGS, which brings its own. 2DGS's
surfels have two scales in place of three; in their second row, all seven other channels have a gradient too. The
contestants take turns; medians of what each took, by the clock, or with --cpu-time by the processor's time.
"""

from __future__ import annotations

import argparse
import math
import os
import statistics
import tempfile
import time


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--width", type=int, default=160)
    parser.add_argument("--height", type=int, default=90)
    parser.add_argument("--points", type=int, default=12000)
    parser.add_argument("--rounds", type=int, default=25)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--cpu-time", action="store_true", help="count the processor's time, on a machine with others")
    args = parser.parse_args()
    for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ[name] = str(args.threads)

    import torch
    from legs_adapters.shims.inria import forks, taming
    from legs_adapters.shims.inria.survey import Interface, InterfaceCall
    from legs_adapters.shims.modules import FasterGSCudaBackend as fastergs
    from legs_adapters.shims.modules import diff_gaussian_rasterization as inria
    from legs_adapters.shims.modules import diff_gaussian_rasterization_fastgs as fastgs
    from legs_adapters.shims.modules import diff_surfel_rasterization as surfels

    from legs_loss.kernels.contract import terms_of
    from legs_loss.kernels.numba_loss import BACKEND
    from legs_loss.lab.embedded import write_embedded_scene
    from legs_loss.lab.rasterizer import Gaussians, rasterize
    from legs_loss.scenes import read_scene

    torch.set_num_threads(args.threads)
    with tempfile.TemporaryDirectory() as folder:
        scene = read_scene(
            write_embedded_scene(folder, views=2, width=args.width, height=args.height, points=args.points, samples=1)
        )
        start = Gaussians.from_points(scene.points.xyz, scene.points.rgb, 3)
        camera = scene.views[0].camera
    target = torch.rand(3, args.height, args.width)
    background = torch.zeros(3)
    view = torch.tensor(camera.world_to_camera, dtype=torch.float32).T.contiguous()
    tanx, tany = args.width / (2 * camera.fx), args.height / (2 * camera.fy)
    projection = torch.zeros(4, 4)
    projection[0, 0], projection[1, 1], projection[2, 2], projection[2, 3] = 1 / tanx, 1 / tany, 1.0001, -0.01
    projection[0, 2], projection[1, 2] = 2 * camera.cx / args.width - 1, 2 * camera.cy / args.height - 1
    projection[3, 2] = 1
    fields = {
        "image_height": args.height, "image_width": args.width, "tanfovx": tanx, "tanfovy": tany, "bg": background,
        "scale_modifier": 1.0, "viewmatrix": view, "projmatrix": view @ projection.T, "sh_degree": 3,
        "campos": view.inverse()[3, :3], "prefiltered": False, "debug": False,
    }  # fmt: skip

    def with_depth(module):
        interface = Interface()
        line = standing.__code__.co_firstlineno
        names = ("rendered_image", "radii", "rendered_depth", "rendered_alpha")
        interface.calls = [InterfaceCall(os.path.realpath(__file__), line, line + 40, names)]
        return module.module("diff_fork", interface)

    def direct(raw, columns):
        viewspace = torch.zeros(len(raw), columns, requires_grad=True)
        return rasterize(
            raw.means, raw.scales, torch.nn.functional.normalize(raw.quaternions), raw.opacities, raw.sh, camera,
            background, 3, viewspace,
        ).image, ()  # fmt: skip

    class FasterGS(torch.autograd.Function):
        """As the method's own Python calls its backend."""

        settings = (view.T[:3], fields["campos"], background, 16, args.width, args.height, camera.fx, camera.fy,
                    camera.cx, camera.cy, 0.2, 1e4, False)  # fmt: skip

        @staticmethod
        def forward(ctx, info, *raw):
            image, *buffers, instances, buckets, selector = fastergs.forward(*raw, *FasterGS.settings)
            ctx.info, ctx.numbers = info, (instances, buckets, selector)
            ctx.save_for_backward(image, *raw[:4], raw[5], *buffers)
            return image

        @staticmethod
        def backward(ctx, gradient):
            return (None, *fastergs.backward(ctx.info, gradient, *ctx.saved_tensors, *FasterGS.settings, *ctx.numbers))

    class OwnAdam:
        """FasterGS's optimiser: its backend's step, for each tensor."""

        def __init__(self, tensors):
            self.tensors, self.steps = tensors, 0
            self.moments = [(torch.zeros_like(tensor), torch.zeros_like(tensor)) for tensor in tensors]

        def step(self):
            self.steps += 1
            for tensor, moments in zip(self.tensors, self.moments):
                fastergs.adam_step(tensor.grad, tensor, *moments, self.steps, 1e-5, 0.9, 0.999, 1e-15)

        def zero_grad(self, set_to_none=True):
            for tensor in self.tensors:
                tensor.grad = None

    info = torch.zeros(2, len(start))

    def standing(module, raw, columns, split, more):
        settings = module.GaussianRasterizationSettings(**fields, **more)
        means2D = torch.zeros(len(raw), columns, requires_grad=True)
        colours = {"dc": raw.sh[:, :1], "shs": raw.sh[:, 1:]} if split else {"shs": raw.sh}
        results = module.GaussianRasterizer(settings)(
            means3D=raw.means,
            means2D=means2D,
            opacities=raw.opacities,
            scales=raw.scales,
            rotations=torch.nn.functional.normalize(raw.quaternions),
            **colours,
        )
        return results[0], results

    plain_module, depth_module = forks.module("diff_fork", Interface()), with_depth(forks)
    contestants = {
        "reference": lambda raw: direct(raw, 2),
        "reference, absolute sums": lambda raw: direct(raw, 4),
        "inria": lambda raw: standing(inria, raw, 3, False, {}),
        "taming": lambda raw: standing(taming, raw, 3, True, {"pixel_weights": None}),
        "fastgs": lambda raw: standing(fastgs, raw, 4, True, {"mult": 0.5, "get_flag": None, "metric_map": None}),
        "generic": lambda raw: standing(plain_module, raw, 3, False, {}),
        "generic, depth and alpha": lambda raw: standing(depth_module, raw, 3, False, {}),
        "fastergs": lambda raw: (FasterGS.apply(info, *raw), ()),
        "surfels": lambda raw: standing(surfels, raw, 3, False, {}),
        "surfels, all channels": lambda raw: standing(surfels, raw, 3, False, {}),
    }
    baselines = {"fastgs": "reference, absolute sums"}

    names = ("means", "log_scales", "quaternions", "opacity_logits", "sh")
    states = {}
    for name in contestants:
        values = [getattr(start, field) for field in names]
        if name.startswith("surfels"):
            values[1] = values[1][:, :2]
        if name == "fastergs":
            values[4:] = values[4][:, :1], values[4][:, 1:]
        tensors = [value.clone().contiguous().requires_grad_(True) for value in values]
        if name == "fastergs":
            states[name] = tensors, OwnAdam(tensors)
        else:
            states[name] = Gaussians(*tensors), torch.optim.Adam(tensors, lr=1e-5)

    others = torch.randn(7, args.height, args.width) / (args.height * args.width)
    now = time.process_time if args.cpu_time else time.perf_counter

    def step(name):
        raw, optimizer = states[name]
        begin = now()
        image, results = contestants[name](raw)
        drawn = now()
        if name == "surfels, all channels":
            torch.autograd.backward([BACKEND.loss(terms_of(0.2), image, target), results[2]], [None, others])
        else:
            BACKEND.loss(terms_of(0.2), image, target).backward()
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        return drawn - begin, now() - begin

    for name in contestants:
        step(name), step(name)
    times = {name: [] for name in contestants}
    for _ in range(args.rounds):
        for name in contestants:
            times[name].append(step(name))
    whole = {name: statistics.median(total for _, total in found) for name, found in times.items()}
    print(f"{args.width}x{args.height}, {len(start):,} Gaussians, degree 3, {args.threads} thread(s), torch "
          f"{torch.__version__}, median of {args.rounds}")  # fmt: skip
    print(f"| {'':<26} | draw, ms | iteration, ms | times the reference |\n| --- | --- | --- | --- |")
    for name, found in times.items():
        drawn = statistics.median(first for first, _ in found)
        ratio = whole[name] / whole[baselines.get(name, "reference")]
        print(f"| {name:<26} | {1000 * drawn:.1f} | {1000 * whole[name]:.1f} | {ratio:.2f} |")
    assert all(math.isfinite(value) for value in whole.values())


if __name__ == "__main__":
    main()
