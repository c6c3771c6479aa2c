"""Add the metrics that came later to the rows of a finished `legs compare`, from the Gaussians that it left.

    python docs/evidence/rescore.py OUT

Held-out views are drawn again; their PSNR must be the row's, else the row is left as it is.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Sequence

from torch import Tensor

from legs_loss.experiments.arms import parse_arm
from legs_loss.experiments.running import Row, read_rows, scene_of, write_json
from legs_loss.experiments.upstream.training import read_picture
from legs_loss.reference.ply import read_ply
from legs_loss.reference.training.dataset import load_view, split_views
from legs_loss.reference.training.metrics import METRICS, mean_scores, score
from legs_loss.reference.training.trainer import TrainConfig, draw, point_cloud
from legs_loss.scenes import Scene

CLOSE = 0.01  # dB; pictures have 8 bits


def rescore(out: Path) -> None:
    """Write each row of a comparison anew, with all metrics of its held-out views."""
    settings, rows = read_rows(out)
    scene = scene_of(settings)
    wanted = [key for key, metric in METRICS.items() if metric.computes(_first(scene, rows), "test")]
    for row in rows:
        scores = row["metrics"]["views"]["test"]
        if all(set(wanted) <= set(one) for one in scores.values()):
            continue
        folder = out / parse_arm(row["arm"]).folder / f"seed-{row['seed']}"
        config = TrainConfig.from_dict(row["config"])
        again = {}
        for view in split_views(scene)[1]:
            loaded = load_view(scene, view, config.resolution)
            if "upstream" in row:
                path = folder / row["upstream"]["pictures"][view.name]
                truth = read_picture(path.parents[1] / "gt" / path.name)
                again[path.name] = score(read_picture(path), truth)
            else:
                again[view.name] = score(draw(read_ply(point_cloud(folder, config)), loaded, config), loaded.image)
        off = max(abs(again[name]["psnr"] - scores[name]["psnr"]) for name in scores)
        if off > CLOSE:
            print(f"{row['arm']}, seed {row['seed']}: drawn again, PSNR differs by {off:.3f} dB: left as it is")
            continue
        for name in scores:
            scores[name] = {**again[name], **scores[name]}
        row["metrics"]["test"] = mean_scores(list(scores.values()))
        write_json(folder / "row.json", row)
        print(f"{row['arm']}, seed {row['seed']}: PSNR to {off:.4f} dB, now with {', '.join(wanted)}", flush=True)


def _first(scene: Scene, rows: Sequence[Row]) -> Tensor:
    """Return a held-out photograph at the size that it was scored at."""
    resolution = TrainConfig.from_dict(rows[0]["config"]).resolution
    return load_view(scene, split_views(scene)[1][0], resolution).image


if __name__ == "__main__":
    rescore(Path(sys.argv[1]))
