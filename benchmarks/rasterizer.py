"""Speed of the compiled rasterizer, forward and backward, against the readable oracle and gsplat's torch reference.

    python -m benchmarks.rasterizer --threads 1
    python -m benchmarks.rasterizer --threads 1 --gsplat DIR    # after: pip install --target DIR gsplat==1.5.3

All contestants draw the same Gaussians, one after the other in every round, so that whatever else the machine does
falls on all of them; the table shows medians over the rounds, the least time of all, the processor's own time (the
median; on one thread, the time it would take if nothing else ran), and ratios of medians.

What is compared of gsplat (1.5.3 runs; it is not part of this project): `_quat_scale_to_covar_preci`,
`_fully_fused_projection`, `_spherical_harmonics` and `accumulate` of gsplat/cuda/_torch_impl.py, as they are, on the
CPU. Two things its torch path takes from CUDA code are supplied here: the list of (Gaussian, pixel) pairs that
contribute, which is made beforehand and NOT timed (in gsplat a kernel makes it), and the two functions of nerfacc that
`accumulate` calls, written below with torch's own cumulative sums. So gsplat's time is a lower bound of its time.
"""

from __future__ import annotations

import argparse
import json
import platform
import shlex
import statistics
import sys
import time
from types import ModuleType, SimpleNamespace

import numpy as np
import torch

from legs_loss.lab import rasterizer
from tests.lab import oracle

BACKGROUND = (0.0, 0.0, 0.0)


def make_scene(count, width, height, degree, seed=0):
    """Gaussians that fill the view, about 4.3 tiles of 16x16 each, of every shape, opacity and depth."""
    generator = torch.Generator().manual_seed(seed)
    focal = 0.875 * width
    depth = 2 + 6 * torch.rand(count, 1, generator=generator)
    pixel = torch.rand(count, 2, generator=generator) * torch.tensor([float(width), float(height)])
    means = torch.cat([(pixel - torch.tensor([width / 2, height / 2])) / focal * depth, depth], 1)
    scales = 1.9 * torch.exp(0.5 * torch.randn(count, 3, generator=generator)) * depth / focal
    quaternions = torch.randn(count, 4, generator=generator)
    opacities = torch.sigmoid(1.5 * torch.randn(count, 1, generator=generator) - 1)
    sh = 0.2 * torch.randn(count, (degree + 1) ** 2, 3, generator=generator)
    camera = SimpleNamespace(
        width=width, height=height, fx=focal, fy=focal, cx=width / 2, cy=height / 2, world_to_camera=np.eye(4)
    )
    leaves = [tensor.requires_grad_() for tensor in (means, scales, quaternions, opacities, sh)]
    return leaves, camera, torch.randn(3, height, width, generator=generator)


def ours(home, camera, degree):
    return lambda *leaves: home.rasterize(*leaves, camera, BACKGROUND, degree).image


def project(leaves, camera):
    """Splats, and the bounds of their tiles; the camera stands in the origin."""
    from legs_loss.lab.conventions import Pinhole

    view = Pinhole.from_camera(camera)
    splats = oracle.project(*(leaf.detach() for leaf in leaves[:3]), view)
    return splats, oracle.tile_bounds(splats.centres, splats.radii, view.tiles)


def describe(leaves, camera, threads):
    _, bounds = project(leaves, camera)
    tiles = int((bounds[:, 2:] - bounds[:, :2]).clamp_min(0).prod(1).sum())
    return f"{camera.width}x{camera.height}, {len(leaves[0])} Gaussians, {tiles} tile entries, {threads} thread(s), ms"


def contributing_pairs(leaves, camera):
    """Indices (Gaussian, pixel) where alpha reaches 1/255, sorted by pixel and depth."""
    from legs_loss.lab.conventions import MIN_ALPHA

    splats, bounds = project(leaves, camera)
    opacities = leaves[3].detach()
    xs, ys = torch.arange(camera.width, dtype=torch.float32), torch.arange(camera.height, dtype=torch.float32)
    gaussians, pixels = [], []
    for i in torch.sort(splats.depths, stable=True).indices.tolist():
        left, top, right, bottom = (16 * bounds[i]).tolist()
        dx, dy = xs[left:right] - splats.centres[i, 0], ys[top:bottom, None] - splats.centres[i, 1]
        a, b, c = splats.conics[i].tolist()
        alpha = opacities[i] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
        y, x = torch.nonzero(alpha >= MIN_ALPHA).unbind(1)
        pixels.append((y + top) * camera.width + x + left)
        gaussians.append(torch.full_like(pixels[-1], i))
    gaussian_ids, pixel_ids = torch.cat(gaussians), torch.cat(pixels)
    order = torch.sort(pixel_ids, stable=True).indices
    return gaussian_ids[order], pixel_ids[order]


def nerfacc_stand_in():
    """The two functions that gsplat's `accumulate` takes from nerfacc, for sorted rays, in torch."""

    def render_weight_from_alpha(alphas, ray_indices, n_rays):
        logs = torch.log1p(-alphas.double())
        before = torch.cumsum(logs, 0) - logs
        starts = torch.searchsorted(ray_indices, torch.arange(n_rays)).clamp_max(len(alphas) - 1)
        transmittance = torch.exp(before - before[starts][ray_indices]).to(alphas.dtype)
        return alphas * transmittance, transmittance

    def accumulate_along_rays(weights, values, ray_indices, n_rays):
        source = weights[:, None] if values is None else weights[:, None] * values
        return torch.zeros(n_rays, source.shape[1]).index_add(0, ray_indices, source)

    module = ModuleType("nerfacc")
    module.render_weight_from_alpha = render_weight_from_alpha
    module.accumulate_along_rays = accumulate_along_rays
    return module


def gsplat(path, camera, degree, gaussian_ids, pixel_ids):
    sys.path.append(path)
    sys.modules["nerfacc"] = nerfacc_stand_in()
    from gsplat.cuda import _torch_impl as reference

    matrix = torch.tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    image_ids = torch.zeros_like(gaussian_ids)

    def draw(means, scales, quaternions, opacities, sh):
        covariances, _ = reference._quat_scale_to_covar_preci(quaternions, scales, True, False)
        _, means2d, _, conics, _ = reference._fully_fused_projection(
            means, covariances, torch.eye(4)[None], matrix[None], camera.width, camera.height
        )
        rgb = (reference._spherical_harmonics(degree, means, sh) + 0.5).clamp_min(0)
        image, _ = reference.accumulate(
            means2d,
            conics,
            opacities[None, :, 0],
            rgb[None],
            gaussian_ids,
            pixel_ids,
            image_ids,
            camera.width,
            camera.height,
        )
        return image[0].permute(2, 0, 1)

    return draw


def measure(contestants, leaves, weights, rounds):
    """Milliseconds of every round by contestant, {name: {"forward": [...], "backward": [...]}}; and the images."""
    times = {name: {"forward": [], "backward": [], "cpu": []} for name in contestants}
    images = {}
    for turn in range(rounds + 1):  # the first one compiles and warms up
        for name, draw in contestants.items():
            for leaf in leaves:
                leaf.grad = None
            cpu, begin = time.process_time(), time.perf_counter()
            image = draw(*leaves)
            middle = time.perf_counter()
            image.backward(weights)
            end = time.perf_counter()
            images[name] = image.detach()
            if turn:
                times[name]["forward"].append(1e3 * (middle - begin))
                times[name]["backward"].append(1e3 * (end - middle))
                times[name]["cpu"].append(1e3 * (time.process_time() - cpu))
    return times, images


def report(title, times, images):
    print(f"\n{title}")
    columns = ("forward", "backward", "both", "min", "cpu")
    print(" " * 14 + "".join(f"{column:>10}" for column in columns) + f"{'ratio':>9}{'largest difference':>20}")
    rows, first = {}, None
    for name, parts in times.items():
        both = [a + b for a, b in zip(parts["forward"], parts["backward"])]
        row = {part: statistics.median(values) for part, values in parts.items()}
        row.update(both=statistics.median(both), min=min(both), rounds=len(both))
        first = first or (name, row)
        row["ratio"] = row["both"] / first[1]["both"]
        row["largest_difference"] = (images[name] - images[first[0]]).abs().max().item()
        rows[name] = row
        line = f"{name:14}" + "".join(f"{row[column]:10.1f}" for column in columns)
        print(line + f"{row['ratio']:8.1f}x{row['largest_difference']:20.1e}")
    return rows


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gaussians", type=int, default=50_000)
    parser.add_argument("--size", type=int, nargs=2, default=(400, 266), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--degree", type=int, default=1, choices=(0, 1, 2, 3))
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=31)
    parser.add_argument("--peer-scale", type=int, default=4, help="the peers draw a view this much smaller in area")
    parser.add_argument("--peer-rounds", type=int, default=5, help="0: no peers")
    parser.add_argument("--gsplat", metavar="DIR", help="where gsplat is installed; without it, it is left out")
    parser.add_argument("--json", metavar="FILE", help="write the numbers here too")
    options = parser.parse_args()

    import numba

    torch.set_num_threads(options.threads)
    command = shlex.join(["python", *sys.argv])
    print(command)
    print(f"{platform.processor() or platform.machine()}, torch {torch.__version__}, numba {numba.__version__}")
    results = {"command": command, "torch": torch.__version__, "numba": numba.__version__, "threads": options.threads}

    width, height = options.size
    leaves, camera, weights = make_scene(options.gaussians, width, height, options.degree)
    title = describe(leaves, camera, options.threads)
    contestants = {"numba": ours(rasterizer, camera, options.degree)}
    results["full"] = {"title": title, **report(title, *measure(contestants, leaves, weights, options.rounds))}

    if options.peer_rounds:
        root = options.peer_scale**0.5
        width, height, count = round(width / root), round(height / root), options.gaussians // options.peer_scale
        leaves, camera, weights = make_scene(count, width, height, options.degree)
        title = describe(leaves, camera, options.threads)
        contestants = {
            "numba": ours(rasterizer, camera, options.degree),
            "torch oracle": ours(oracle, camera, options.degree),
        }
        if options.gsplat:
            pairs = contributing_pairs(leaves, camera)
            contestants["gsplat torch"] = gsplat(options.gsplat, camera, options.degree, *pairs)
        results["peers"] = {
            "title": title,
            **report(title, *measure(contestants, leaves, weights, options.peer_rounds)),
        }

    if options.json:
        with open(options.json, "w") as file:
            json.dump(results, file, indent=2)
            file.write("\n")


if __name__ == "__main__":
    main()
