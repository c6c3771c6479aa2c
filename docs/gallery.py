"""Make the gallery's pictures: ``python docs/gallery.py`` draws docs/pictures/gallery_*.jpg from the embedded scene."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import List, Tuple

import torch
from matplotlib.figure import Figure
from torch import Tensor

from legs_loss import WeightSpec, response, weight_map
from legs_loss.cli.masks import mask_of
from legs_loss.curves import curve_names
from legs_loss.lab.embedded import write_embedded_scene
from legs_loss.operators import OPERATORS
from legs_loss.responses import gaussian_blur, normalise_response
from legs_loss.scenes import image_tensor, load_training_image, read_scene

PICTURES = Path(__file__).resolve().parent / "pictures"


def sheet(name: str, columns: int, pictures: List[Tuple[str, Tensor, str, float]]) -> None:
    """Save pictures (title, values, colours, the value of the brightest colour) side by side."""
    rows = -(-len(pictures) // columns)
    figure = Figure(figsize=(3.2 * columns, 2.65 * rows), constrained_layout=True)
    for place, (title, values, colours, most) in enumerate(pictures):
        cell = figure.add_subplot(rows, columns, place + 1)
        if values.dim() == 3 and len(values) == 3:
            cell.imshow(values.permute(1, 2, 0).numpy())
        else:
            drawn = cell.imshow(values[0].numpy(), cmap=colours, vmin=0, vmax=most)
            figure.colorbar(drawn, ax=cell, shrink=0.8)
        cell.set_title(title, fontsize=10)
        cell.set_axis_off()
    figure.savefig(str(PICTURES / f"gallery_{name}.jpg"), dpi=110, facecolor="white", pil_kwargs={"quality": 85})


def main() -> None:
    """Draw operators, curves, betas and a mask on the same photograph."""
    with tempfile.TemporaryDirectory() as folder:
        view = read_scene(write_embedded_scene(Path(folder) / "scene", views=9, width=320, height=240)).views[4]
        image = image_tensor(load_training_image(view))
        mask = torch.from_numpy(mask_of(view, ["sharpness"], {}))[None]
    photograph = ("photograph", image, "", 1.0)
    strengths = [(name, normalise_response(response(image, name))) for name in OPERATORS]
    most = float(torch.quantile(strengths[0][1], 0.99))
    sheet("operators", 3, [photograph, *((name, strength, "magma", most) for name, strength in strengths)])
    curves = [(f"{name}, beta 10", weight_map(image, WeightSpec(curve=name))) for name in curve_names()]
    titled = [(f"{name}: mean {float(weight.mean()):.2f}", weight, "viridis", 11.0) for name, weight in curves]
    sheet("curves", 3, [photograph, *titled])
    betas = [(beta, weight_map(image, WeightSpec(beta=float(beta)))) for beta in (1, 4, 10, 20)]
    titled = [(f"beta {beta}: mean {float(weight.mean()):.2f}", weight, "viridis", 21.0) for beta, weight in betas]
    sheet("beta", 2, titled)
    masked = ("weight times mask", mask * weight_map(image), "viridis", 11.0)
    sheet("masks", 3, [photograph, ("mask: legs masks --from sharpness", mask, "gray", 1.0), masked])
    rendering = 0.6 * gaussian_blur(image, 2.0)
    hidden = torch.where(mask == 0, image, rendering)
    difference = (hidden - image).abs().mean(0, keepdim=True)
    shown = [("a rendering, too dark", rendering, "", 1.0), ("masked(rendering, photograph)", hidden, "", 1.0)]
    sheet("masked", 3, [*shown, ("what every loss sees: the difference", difference, "magma", float(difference.max()))])


if __name__ == "__main__":
    main()
