"""A contact sheet: photograph, response and weight map of some views, and the curves."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple, Optional, Sequence, Union

import numpy as np
import torch

from legs_loss.cli.shared.saving import label, save_figure
from legs_loss.curves import curve, curve_names
from legs_loss.errors import require
from legs_loss.spec import WeightSpec
from legs_loss.weights import curved, weight_from_response

_INK, _FAINT = "#222222", "#9a9a9a"


class Shown(NamedTuple):
    """One view of a sheet: its label, its photograph uint8 or uint16 [H, W, C] if there is one, its E^ [H, W].

    For a spec that is normalised over the scene, E^ is its response normalised so. The user's own mask and weights are
    factors of the weight, [H, W], or 1.
    """

    label: str
    photograph: Optional[np.ndarray]
    normalised: np.ndarray
    mask: Union[np.ndarray, float] = 1.0
    weights: Union[np.ndarray, float] = 1.0


def save_sheet(path: Union[str, Path], views: Sequence[Shown], spec: WeightSpec, title: str) -> None:
    """Draw the sheet to a PNG: photograph, E^ and W of every view with colour bars, and the curves below.

    The bar of E^ ends at its 99th percentile over the views: a few pixels own the maximum.

    Raises:
        LegsError: matplotlib is missing, or the file cannot be written.
    """
    require("a picture", "report", "matplotlib")
    from matplotlib.figure import Figure

    rows = 4 if any(np.ndim(view.mask) for view in views) else 3
    aspect = max(view.normalised.shape[0] / view.normalised.shape[1] for view in views)
    column = min(4.2, 3.6 / aspect)
    width, height = column * len(views) + 1.4, rows * column * aspect
    figure: Any = Figure(figsize=(max(7.0, width), height + 4.4), constrained_layout=True)
    figure.suptitle(label(title), fontsize=13, color=_INK)
    maps, below = figure.subfigures(2, 1, height_ratios=[height + 0.8, 3.4])
    grid = maps.subplots(rows, len(views) + 1, gridspec_kw={"width_ratios": [1] * len(views) + [0.06]})
    _draw_maps(grid[:, :-1], grid[:, -1], views, spec)
    _draw_curves(below.subplots(), spec)
    save_figure(figure, path, 140)


def _draw_maps(cells: Any, bars: Any, views: Sequence[Shown], spec: WeightSpec) -> None:
    """Fill cells [rows, views] and the colour bars of the rows: photograph, mask if there is one, response, weight."""
    masked = len(cells) == 4
    least = 0 if masked or any(np.ndim(view.weights) for view in views) else 1
    most = max(float(np.max(view.weights)) for view in views)
    # A few pixels own the maximum: shown up to it, a response is all black.
    brightest = max(float(np.quantile(view.normalised.astype(np.float32), 0.99)) for view in views) or 1.0
    for column, view in enumerate(views):
        photograph, response, weighted = cells[[0, -2, -1], column]
        for axes in cells[:, column]:
            axes.set(xticks=[], yticks=[], frame_on=False)
        weighted_by = curved if spec.over == "scene" else weight_from_response
        weight = weighted_by(torch.from_numpy(view.normalised.astype(np.float32))[None], spec)[0].numpy()
        weight = weight * view.mask * view.weights
        mask = np.ones_like(weight) * view.mask
        if masked:
            cells[1, column].imshow(mask, cmap="gray", vmin=0, vmax=1)
        if view.photograph is None:
            photograph.text(0.5, 0.5, "not found,\nor changed since", ha="center", va="center", color=_FAINT)
        else:
            unit = view.photograph / np.float32(np.iinfo(view.photograph.dtype).max)
            photograph.imshow(unit.squeeze(-1) if unit.shape[-1] == 1 else unit, cmap="gray", vmin=0, vmax=1)
        strengths = response.imshow(view.normalised.astype(np.float32), cmap="magma", vmin=0, vmax=brightest)
        weights = weighted.imshow(weight, cmap="viridis", vmin=least, vmax=(1 + (spec.beta or 1)) * most)
        mean = weight.sum() / max(float(mask.sum()), 1e-9)
        over = " of what counts" if np.ndim(view.mask) else ""
        weighted.set_xlabel(f"mean weight{over} {mean:.2f}", fontsize=9, color=_INK)
        photograph.set_title(label(view.label), fontsize=10, color=_INK)
    names = ["photograph", *(["mask"] if masked else []), r"response  $\hat{E}$", "weight  $W$"]
    for axes, name in zip(cells[:, 0], names):
        axes.set_ylabel(name, fontsize=11, color=_INK)
    figure = cells[0, 0].figure
    for bar in bars[:-2]:
        bar.axis("off")
    figure.colorbar(strengths, cax=bars[-2], extend="max" if brightest < 1 else "neither")
    figure.colorbar(weights, cax=bars[-1])


def _draw_curves(axes: Any, spec: WeightSpec) -> None:
    x = torch.linspace(0.0, 1.0, 501)
    for name in curve_names():
        chosen = name == spec.curve
        style = {"linewidth": 2.6, "zorder": 3} if chosen else {"linewidth": 1.3, "alpha": 0.75}
        axes.plot(x.numpy(), curve(name)(x).numpy(), label=f"{name} (this sheet)" if chosen else name, **style)
    axes.set_title(r"curves $f$:  $W = 1 + \beta\, f(\hat{E})$", fontsize=11, color=_INK)
    axes.set(xlabel=r"normalised response $\hat{E}$", ylabel=r"$f(\hat{E})$", xlim=(0, 1), ylim=(0, 1))
    axes.grid(alpha=0.25)
    axes.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
