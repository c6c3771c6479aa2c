"""Scores of rendered views: PSNR, SSIM and, where the package lpips is installed, LPIPS with VGG."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Dict, List, Optional

import numpy as np
import torch

from legs_loss import ssim
from legs_loss.scenes import open_image


def gaussians(cloud: Path) -> int:
    """The number of Gaussians that the header of a .ply tells."""
    with open(str(cloud), "rb") as file:
        for line in file:
            if line.startswith(b"element vertex"):
                return int(line.split()[-1])
            if line.startswith(b"end_header"):
                break
    raise ValueError(f"{cloud}: no number of Gaussians in its header")


def score(renders: Path, truths: Path) -> Dict[str, Any]:
    """Return the scores of each view, by name, and their means; both folders have the same names."""
    names = sorted(path.name for path in renders.glob("*.png"))
    if not names or names != sorted(path.name for path in truths.glob("*.png")):
        raise ValueError(f"{renders} and {truths} do not hold the same views")
    network = _lpips()
    views: Dict[str, Dict[str, Optional[float]]] = {}
    for name in names:
        image, truth = _read(renders / name), _read(truths / name)
        error = float((image - truth).double().square().mean())
        views[name] = {
            "psnr": -10 * float(np.log10(max(error, 1e-12))),
            "ssim": float(ssim(image, truth)),
            "lpips": None if network is None else float(network(image[None], truth[None], normalize=True)),
        }
    means = {}
    for key in ("psnr", "ssim", "lpips"):
        values: List[Any] = [scores[key] for scores in views.values()]
        means[key] = None if None in values else float(np.mean(values))
    return dict(means, views=views)


def _read(path: Path) -> torch.Tensor:
    with open_image(path) as image:
        pixels = np.asarray(image.convert("RGB"), np.float32) / 255.0
    return torch.from_numpy(pixels).permute(2, 0, 1).contiguous()


_NETWORK: List[Any] = []


def _lpips() -> Any:
    if not _NETWORK:
        try:
            import lpips
        except ImportError:
            _NETWORK.append(None)
        else:
            _NETWORK.append(lpips.LPIPS(net="vgg", verbose=False).eval())
    return _NETWORK[0]
