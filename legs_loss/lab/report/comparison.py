"""Pictures of several trainings of one scene beside each other: rendering, error map and weight map of one view."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple, Sequence, Tuple

import numpy as np
import torch
from torch import Tensor

from legs_loss.cli.shared.saving import label, save_figure
from legs_loss.lab.report.html_pictures import as_bytes
from legs_loss.lab.training.metrics import strongest
from legs_loss.responses import normalise_response, response
from legs_loss.system.files import write_whole

_INK = "#222222"


class Compared(NamedTuple):
    """One training's pictures of the view: rendering [3, H, W], weight map [1, H, W], and a line about it."""

    name: str
    rendering: Tensor
    weight: Tensor
    caption: str


def save_pictures(folder: Path, title: str, photograph: Tensor, arms: Sequence[Compared]) -> Path:
    """Write each arm's NAME-rendering.png, NAME-error.png and NAME-weight.png, and all on one sheet.

    Errors are the mean over channels of |U - F|. All error maps share one scale, from 0 to the 99.5th percentile over
    the arms; weight maps go from 1 to the largest weight. Returns the path of the sheet, ``comparison.png``.
    """
    from matplotlib import colormaps

    errors = [(arm.rendering.clamp(0, 1) - photograph).abs().mean(0).numpy() for arm in arms]
    most_error = float(np.quantile(np.stack(errors), 0.995)) or 1.0
    most_weight = max(2.0, *(float(arm.weight.max()) for arm in arms))
    save_png(as_bytes(photograph), folder / "photograph.png")
    for arm, error in zip(arms, errors):
        weight = (arm.weight[0].numpy() - 1) / (most_weight - 1)
        pictures = {
            "rendering": as_bytes(arm.rendering),
            "error": colormaps["magma"](error / most_error, bytes=True)[..., :3],
            "weight": colormaps["viridis"](weight, bytes=True)[..., :3],
        }
        for kind, pixels in pictures.items():
            save_png(pixels, folder / f"{arm.name}-{kind}.png")
    sheet = folder / "comparison.png"
    _sheet(sheet, title, photograph, arms, errors, most_error, most_weight)
    return sheet


def _sheet(
    path: Path,
    title: str,
    photograph: Tensor,
    arms: Sequence[Compared],
    errors: Sequence[np.ndarray],
    most_error: float,
    most_weight: float,
) -> None:
    from matplotlib.figure import Figure

    height, width = photograph.shape[1:]
    rows = len(arms) + 1
    aspect = height / width
    figure: Any = Figure(figsize=(4 * 3.2 + 1.0, rows * (3.2 * aspect + 0.28) + 1.0), constrained_layout=True)
    figure.suptitle(label(title), fontsize=13, color=_INK)
    grid = figure.subplots(rows, 4)
    for axes in grid.ravel():
        axes.set(xticks=[], yticks=[], frame_on=False)
    detail = _detail(photograph)
    normalised = normalise_response(response(photograph))[0].numpy()
    grid[0, 0].imshow(as_bytes(photograph))
    grid[0, 1].imshow(as_bytes(photograph)[detail], interpolation="nearest")
    grid[0, 2].imshow(strongest(photograph).numpy(), cmap="gray")
    grid[0, 3].imshow(normalised, cmap="magma", vmax=float(np.quantile(normalised, 0.99)) or 1.0)
    grid[0, 0].set_ylabel("photograph", fontsize=11, color=_INK)
    for axes, heading in zip(grid[0], ("", "detail", "strongest 10% of the response", r"response  $\hat{E}$")):
        axes.set_title(heading, fontsize=11, color=_INK)
    for row, (arm, error) in zip(grid[1:], zip(arms, errors)):
        row[0].imshow(as_bytes(arm.rendering))
        row[1].imshow(as_bytes(arm.rendering)[detail], interpolation="nearest")
        shown_error = row[2].imshow(error, cmap="magma", vmin=0, vmax=most_error)
        shown_weight = row[3].imshow(arm.weight[0].numpy(), cmap="viridis", vmin=1, vmax=most_weight)
        row[0].set_ylabel(arm.name, fontsize=11, color=_INK)
        row[0].set_xlabel(arm.caption, fontsize=8, color=_INK)
    for axes, heading in zip(grid[1], ("rendering", "detail", "error  $|U - F|$", "weight  $W$")):
        axes.set_title(heading, fontsize=11, color=_INK)
    for axes, shown in ((grid[-1, 2], shown_error), (grid[-1, 3], shown_weight)):
        bar = figure.colorbar(shown, ax=axes, orientation="horizontal", fraction=0.1, aspect=30)
        bar.ax.tick_params(labelsize=8)
    save_figure(figure, path, 130)


def _detail(photograph: Tensor) -> Tuple[slice, slice]:
    """Return the window of a third of the size with the most contours, for a closer look."""
    height, width = photograph.shape[1:]
    size = max(1, height // 3), max(1, width // 3)
    strength = torch.nn.functional.avg_pool2d(response(photograph)[None], size, stride=1)[0, 0]
    row, column = divmod(int(strength.argmax()), strength.shape[1])
    return slice(row, row + size[0]), slice(column, column + size[1])


def save_png(pixels: np.ndarray, path: Path) -> None:
    """Write a picture [H, W, 3] of bytes.

    Raises:
        LegsError: the file cannot be written.
    """
    from PIL import Image

    write_whole(path, lambda file: Image.fromarray(np.ascontiguousarray(pixels)).save(file, "PNG"), folders=True)
