"""Rebuild the tables and plots of docs/evidence.md and of evidence/codebases.md from the rows beside this file.

    python docs/evidence/rebuild.py                           # tables and plots, from the .json files beside it
    python docs/evidence/rebuild.py --take OUT docs/evidence/NAME.json    # first: the rows of a `legs compare` folder
    python docs/evidence/mean_weights.py SCENE docs/evidence/NAME_weights.json

A table stands in the text between `<!-- NAME STUDY -->` and `<!-- end -->`.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any, List, Tuple

from legs_loss.experiments.arms import parse_arm
from legs_loss.experiments.running import read_rows
from legs_loss.experiments.statistics import pooled_difference, summarise_all, times_gaussians
from legs_loss.experiments.studies import STUDIES, Study
from legs_loss.experiments.tables import (
    DIFFERENCES,
    difference_cell,
    differences_table,
    markdown,
    paper_text,
    scores_table,
    times_cell,
    with_values,
)
from legs_loss.reference.training.metrics import METRICS

HERE = Path(__file__).resolve().parent
TEXTS = (HERE.parent / "evidence.md", HERE / "codebases.md")
PICTURES = HERE.parent / "pictures"
SCENES = ("fox", "embedded")
DIGITS = 6


def take(out: Path, path: Path) -> None:
    """Write a comparison's settings and rows as one compact file."""
    settings, rows = read_rows(out)
    settings.pop("path")
    for row in rows:
        row.get("upstream", {}).pop("pictures", None)
        for scores in row["metrics"]["views"]["train"].values():
            for name in [key for key, metric in METRICS.items() if "train" not in metric.splits]:
                scores.pop(name, None)  # of rows that scored training views with it too
    lines = ",\n".join(json.dumps(_rounded(row), separators=(",", ":")) for row in rows)
    path.write_text(f'{{"settings":{json.dumps(settings)},"rows":[\n{lines}\n]}}\n', encoding="utf-8")


def tables(text: str) -> str:
    """Return the text with every table made anew."""

    def table(match: re.Match[str]) -> str:
        if match.group(2) == "weights":
            return f"<!-- {match.group(1)} weights -->\n\n{_weights(match.group(1))}\n\n<!-- end -->"
        scene, study = match.group(1), STUDIES[match.group(2)]
        if "+" in scene:
            return f"<!-- {scene} {match.group(2)} -->\n\n{_pooled(scene.split('+'), study)}\n\n<!-- end -->"
        rows = _rows(scene)
        trained = {row["arm"] for row in rows}
        study = study._replace(arms=tuple(arm for arm in study.arms if parse_arm(arm).name in trained))
        parts = [scores_table(rows, study.arms), differences_table(rows, study)]
        if study.paper:
            parts.append(paper_text(rows, study).partition("\n\n")[2])
        return f"<!-- {scene} {match.group(2)} -->\n\n" + "\n\n".join(parts) + "\n\n<!-- end -->"

    return re.sub(r"<!-- ([\w+]+) ([\w-]+) -->.*?<!-- end -->", table, text, flags=re.DOTALL)


def plots() -> None:
    """Draw PSNR by Gaussians of each scene, with the arms' names at their points."""
    from matplotlib.figure import Figure

    figure: Any = Figure(figsize=(11, 8.4), constrained_layout=True)
    grid = figure.subplots(len(SCENES), 2)
    arms = list(dict.fromkeys(parse_arm(arm).name for name in ("main", "controls") for arm in STUDIES[name].arms))
    for panels, scene in zip(grid, SCENES):
        found = summarise_all(_rows(scene), arms)
        for panel, score in zip(panels, ("train PSNR", "held-out PSNR")):
            values = [summary.mean[score] for summary in found]
            line = 0.045 * (max(values) - min(values))  # a label's height, in dB
            labels: List[Tuple[float, float]] = []  # places of those that are written
            for summary in sorted(found, key=lambda one: one.mean[score]):
                x, y = summary.mean["Gaussians"] / 1000, summary.mean[score]
                plain = parse_arm(summary.arm).spec.beta == 0
                colour = "#555555" if plain else "#d62728" if summary.arm == "legs" else "#1f77b4"
                panel.errorbar(x, y, summary.spread[score], fmt="s" if plain else "o", color=colour, markersize=6)
                at = max([y] + [below + line for beside, below in labels if abs(beside - x) < 10])
                labels.append((x, at))
                panel.annotate(f"  {summary.arm}", (x, at), fontsize=9, color=colour, va="center")
            panel.set(xlabel="thousand Gaussians", ylabel=f"{score}, dB", title=scene)
            panel.margins(x=0.25, y=0.12)
            panel.grid(alpha=0.3)
    figure.savefig(str(PICTURES / "evidence_gaussians.png"), dpi=110, facecolor="white")


def _pooled(scenes: List[str], study: Study) -> str:
    """Each arm's differences over several scenes, each with the same share."""
    rows = [_rows(scene) for scene in scenes]
    lines = []
    for arm in study.arms:
        name, reference = parse_arm(arm).name, study.reference(parse_arm(arm).name)
        found = [pooled_difference(rows, name, reference or name, *place) for place in DIFFERENCES.values()]
        if reference is not None and found[0] is not None:
            cells = [difference_cell(each, key) for each, (_, key) in zip(found, DIFFERENCES.values())]
            times = [times_cell(times_gaussians(one, name, reference) or 1.0) for one in rows]
            lines.append([f"{name} − {reference}", *cells, ", ".join(times) if len(set(times)) > 1 else times[0]])
    return markdown(*with_values([f"over {len(scenes)} captures", *DIFFERENCES, "Gaussians"], lines))


def _weights(scene: str) -> str:
    """Mean weights of degraded photographs, measured by mean_weights.py."""
    measured = json.loads((HERE / f"{scene}_weights.json").read_text(encoding="utf-8"))
    arms = list(measured["rows"][0]["mean"])
    lines = [
        [row["photograph"], *(f"{row['mean'][arm]:.2f} ({row['rises'][arm]} of {measured['views']})" for arm in arms)]
        for row in measured["rows"]
    ]
    return markdown(["one photograph of the scene", *(f"{arm}: mean weight (of which it rose)" for arm in arms)], lines)


def _rows(scene: str) -> List[Any]:
    return json.loads((HERE / f"{scene}.json").read_text(encoding="utf-8"))["rows"]


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}")
    if isinstance(value, dict):
        return {name: _rounded(one) for name, one in value.items()}
    if isinstance(value, list):
        return [_rounded(one) for one in value]
    return value


def main(words: List[str]) -> None:
    """Take the files that --take names, then rebuild."""
    while words[:1] == ["--take"]:
        taken: Tuple[str, ...] = tuple(words[1:3])
        take(Path(taken[0]), Path(taken[1]))
        words = words[3:]
    for text in TEXTS:
        text.write_text(tables(text.read_text(encoding="utf-8")), encoding="utf-8")
    plots()


if __name__ == "__main__":
    main(sys.argv[1:])
