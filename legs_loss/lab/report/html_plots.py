"""The plots of a comparison as SVG that takes the page's own colour of text: PSNR by iterations and by Gaussians."""

from __future__ import annotations

import io
from typing import Any, Dict, List, Sequence, Tuple

import numpy as np

from legs_loss.errors import require
from legs_loss.lab.experiments.statistics import Rows

_INK = "#222222"  # replaced by currentColor, so no colour of an arm may be the same
# Tableau's, in the order that keeps neighbours apart; a tenth and more arms differ by their markers.
_COLOURS = (
    *("#7f7f7f", "#1f77b4", "#ff7f0e", "#2ca02c", "#d62728"),
    *("#9467bd", "#8c564b", "#e377c2", "#17becf", "#bcbd22"),
)
_MARKERS = "osD^vPX*<>"


def colours(arms: Sequence[str]) -> Dict[str, Tuple[str, str]]:
    """Return the colour and the marker of each arm.

    >>> colours(["3dgs", "legs"])["legs"]
    ('#1f77b4', 'o')
    """
    count = len(_COLOURS)
    return {arm: (_COLOURS[i % count], _MARKERS[i // count % len(_MARKERS)]) for i, arm in enumerate(arms)}


def by_iterations(rows: Rows, arms: Sequence[str]) -> str:
    """Plot held-out PSNR during the runs: the mean over seeds, a band from the lowest to the highest.

    Returns:
        "" where no row was scored during its run: a codebase's own script scores none.
    """
    if not any(row["metrics"]["history"] for row in rows):
        return ""
    figure, panel = _figure(len(arms))
    style = colours(arms)
    for arm in arms:
        histories = [row["metrics"]["history"] for row in rows if row["arm"] == arm]
        length = min(len(history) for history in histories)
        x = [point["iteration"] for point in histories[0][:length]]
        y = np.array([[point.get("test_psnr", np.nan) for point in history[:length]] for history in histories])
        panel.plot(x, y.mean(0), color=style[arm][0], marker=style[arm][1], markersize=4, linewidth=1.6, label=arm)
        panel.fill_between(x, y.min(0), y.max(0), color=style[arm][0], alpha=0.12, linewidth=0)
    panel.set(xlabel="iterations", ylabel="held-out PSNR, dB")
    _legend(panel)
    return _svg(figure, "iterations", "Held-out PSNR by iterations, one line per arm; the last values are in the table")


def by_gaussians(rows: Rows, arms: Sequence[str]) -> List[str]:
    """Plot training and held-out PSNR by the number of Gaussians at the end: each seed, their mean larger."""
    style = colours(arms)
    plots = []
    for split, title in (("train", "training views"), ("test", "held-out views")):
        figure, panel = _figure(len(arms))
        for arm in arms:
            points = [
                (row["metrics"]["gaussians"], row["metrics"][split]["psnr"])
                for row in rows
                if row["arm"] == arm and row["metrics"][split] is not None
            ]
            if not points:
                continue
            x, y = np.array(points, float).T
            colour, marker = style[arm]
            panel.plot(x, y, marker, color=colour, markersize=4, alpha=0.45)
            panel.plot(x.mean(), y.mean(), marker, color=colour, markersize=9, label=arm)
        panel.set(xlabel="Gaussians", ylabel="PSNR, dB")
        panel.set_title(title, fontsize=11, color=_INK)
        panel.locator_params(axis="x", nbins=5)
        panel.xaxis.set_major_formatter(lambda value, _: f"{value:,.0f}")
        _legend(panel)
        says = f"PSNR of {title} by number of Gaussians, one point per arm; the values are in the table"
        plots.append(_svg(figure, f"gaussians-{split}", says))
    return plots


def _figure(arms: int) -> Tuple[Any, Any]:
    """Return a figure that a telephone shows whole, with room below for the names of the arms."""
    require("a plot", "report", "matplotlib")
    from matplotlib.figure import Figure

    figure: Any = Figure(figsize=(4.6, 3.4 + 0.2 * -(-arms // 3)), constrained_layout=True)
    panel = figure.subplots()
    panel.set_facecolor("none")
    panel.grid(alpha=0.25, linewidth=0.6, color=_INK)
    panel.tick_params(colors=_INK, labelsize=9)
    panel.xaxis.label.set_color(_INK)
    panel.yaxis.label.set_color(_INK)
    for name, spine in panel.spines.items():
        spine.set_visible(name in ("left", "bottom"))
        spine.set_color(_INK)
    return figure, panel


def _legend(panel: Any) -> None:
    if panel.get_legend_handles_labels()[1]:
        panel.legend(
            loc="upper center", bbox_to_anchor=(0.5, -0.17), ncol=3, frameon=False, labelcolor=_INK, fontsize=9
        )


def _svg(figure: Any, salt: str, says: str) -> str:
    """Return the figure as an <svg> element.

    ``says`` is its label for screen readers; ``salt`` makes its ids unique on the page.
    """
    from matplotlib import rc_context

    text = io.StringIO()
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": salt, "font.family": "sans-serif"}):
        figure.savefig(text, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    svg = text.getvalue()
    svg = svg[svg.index("<svg") :].replace(_INK, "currentColor")
    svg = svg.replace("<svg ", f'<svg role="img" aria-label="{says}" ', 1)
    # Groups are numbered alike in every figure; nothing refers to them.
    return svg.replace('<g id="', f'<g id="{salt}-').replace("DejaVu Sans", "system-ui")
