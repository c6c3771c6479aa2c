"""The pictures of a report: an arm's rendering of a view, its error and weight map, and where two arms differ."""

from __future__ import annotations

import base64
import io
from dataclasses import replace
from pathlib import Path
from typing import Any, Dict, List, Mapping, NamedTuple, Optional, Tuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from legs_loss.errors import LegsError
from legs_loss.lab.ply import read_ply
from legs_loss.lab.training.dataset import TrainingView, dimmed, shuffled
from legs_loss.lab.training.trainer import TrainConfig, draw, point_cloud, step_weights
from legs_loss.scenes import image_tensor, open_image
from legs_loss.weights import weight_map

KINDS = ("rendering", "error", "weight")
CROPS = 3  # of each pair of arms and each view
# Tried in order until a page is small enough: lossless first, since it is small differences that are shown.
FORMATS: Tuple[Mapping[str, Any], ...] = (
    {"format": "PNG", "optimize": True},
    {"format": "JPEG", "quality": 92},
    {"format": "JPEG", "quality": 80},
)


class DrawnView(NamedTuple):
    """One arm's view: its rendering [3, H, W] in [0, 1], and the weight map [1, H, W] at the end of its run."""

    rendering: Tensor
    weight: Tensor


class ViewPictures(NamedTuple):
    """A view as a report shows it.

    images: data URIs by arm and kind of picture; the photograph is an arm named "photograph" with a rendering only,
        darkened where its mask leaves it out, as are errors there.
    most_error, most_weight: what the brightest colour of the error and of the weight maps stands for.
    crops: for each pair of arms, sorted, windows (left, top, width, height) where their errors differ most.
    """

    name: str
    width: int
    height: int
    images: Dict[str, Dict[str, str]]
    most_error: float
    most_weight: float
    crops: Dict[str, List[List[int]]]


def draw_row(row: Mapping[str, Any], folder: Path, view: TrainingView, scene: Optional[Tensor] = None) -> DrawnView:
    """Draw a view with a row's Gaussians, and make the weight map of its run there.

    ``scene`` are the levels of the training views, for weights that are normalised over the scene.
    """
    config = TrainConfig.from_dict(row["config"])
    if "upstream" in row:
        rendering = _upstreams_own(row, folder, view)
    else:
        rendering = draw(read_ply(point_cloud(folder, config)), view, config)
    if not config.weights.unweighted:
        view = replace(view, weight=weight_map(view.image, config.weights, scene=scene))
    if config.shuffled:
        view = shuffled([view], config.seed)[0]
    weights = step_weights(view.weight, view, config)
    counted = torch.ones_like(view.image[:1]) if weights.map is None else weights.of_what_counts(weights.map)
    return DrawnView(rendering.clamp(0, 1), counted)


def _upstreams_own(row: Mapping[str, Any], folder: Path, view: TrainingView) -> Tensor:
    """Return the codebase's own rendering of a held-out view."""
    path = row["upstream"]["pictures"].get(view.name)
    full = (folder / path).resolve() if path is not None else None
    if full is None or folder.resolve().parents[1] not in full.parents or not full.is_file():
        raise LegsError(f"{row['arm']} left no rendering of {view.name}: choose held-out views (--views)")
    return read_picture(full)


def read_picture(path: Path) -> Tensor:
    """Return a picture that a codebase wrote, [3, H, W] in [0, 1]."""
    with open_image(path) as image:
        return image_tensor(np.asarray(image.convert("RGB")))


def encode(view: TrainingView, drawn: Mapping[str, DrawnView], form: Mapping[str, Any]) -> ViewPictures:
    """Return a view's pictures. All error maps have one scale, and so have all weight maps (from 0)."""
    from matplotlib import colormaps

    errors = {arm: (view.hidden(one.rendering) - view.image).abs().mean(0) for arm, one in drawn.items()}
    most_error = float(np.quantile(torch.stack(list(errors.values())).numpy(), 0.995)) or 1.0
    most_weight = max(2.0, *(float(one.weight.max()) for one in drawn.values()))
    images = {"photograph": {"rendering": _uri(as_bytes(dimmed(view.image, view.mask)), form)}}
    for arm, one in drawn.items():
        images[arm] = {
            "rendering": _uri(as_bytes(one.rendering), form),
            "error": _uri(colormaps["magma"](errors[arm].numpy() / most_error, bytes=True)[..., :3], form),
            "weight": _uri(colormaps["viridis"](one.weight[0].numpy() / most_weight, bytes=True)[..., :3], form),
        }
    arms = sorted(drawn)
    crops = {
        f"{first}|{second}": differing(errors[first] - errors[second])
        for first in arms
        for second in arms
        if first < second
    }
    height, width = view.image.shape[1:]
    return ViewPictures(view.name, width, height, images, most_error, most_weight, crops)


def differing(difference: Tensor, count: int = CROPS) -> List[List[int]]:
    """Return windows [left, top, width, height] with the largest mean absolute ``difference`` [H, W], largest first.

    They do not overlap; their sides are a quarter of the image's shorter one, at least 8 pixels.

    >>> differing(torch.eye(12)[:, :, None].repeat(1, 1, 2).reshape(12, 24), 1)
    [[0, 0, 8, 8]]
    """
    height, width = difference.shape
    side = max(8, min(height, width) // 4)
    side_y, side_x = min(side, height), min(side, width)
    means = avg_pool2d(difference.abs()[None, None], (side_y, side_x), stride=1)[0, 0]
    found: List[List[int]] = []
    for _ in range(count):
        top, left = divmod(int(means.argmax()), means.shape[1])
        if float(means[top, left]) <= 0:
            break
        found.append([left, top, side_x, side_y])
        means[max(0, top - side_y + 1) : top + side_y, max(0, left - side_x + 1) : left + side_x] = -1
    return found


def as_bytes(image: Tensor) -> np.ndarray:
    """Return an image [C, H, W] in [0, 1], clipped, as bytes [H, W, C]."""
    return (image.clamp(0, 1) * 255).round().to(torch.uint8).permute(1, 2, 0).contiguous().numpy()


def _uri(pixels: np.ndarray, form: Mapping[str, Any]) -> str:
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(buffer, **form)
    return f"data:image/{str(form['format']).lower()};base64,{base64.b64encode(buffer.getvalue()).decode()}"
