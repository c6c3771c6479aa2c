"""Say what a checkout trains with where it has no photometric L1: a line for each thing that is not ours to weight."""

from __future__ import annotations

import re
from typing import Iterable, Iterator

from legs_adapters.code.sources import Source

__all__ = ["trained_instead"]

_SQUARED = "the image loss is squared, not absolute"
_OF_PICTURES = re.compile(r"rgb|im(g|age)|colou?r|delta", re.I)
_INSTEAD = (
    (r"^[ \t]*(import|from) jax\b", "the loss is written in JAX, and legs_loss in torch"),
    (r"^[ \t]*(import|from) mlx\b", "the loss is written in MLX, and legs_loss in torch"),
    (
        r"\bsuper\(\)\.get_loss_dict\(|^class \w+\([\w.]*\bSplatfactoModel\b",
        "the loss is nerfstudio's own: its hook is `ns-train splatfacto-legs`",
    ),
    (
        r"\b\w*(l1\w*ssim|ssim\w*l1)\w*\(",
        "one function computes L1 and SSIM, perhaps a compiled kernel: take both apart, and weight the L1",
    ),
    (r"mse_loss\w*\(|\bMSELoss\(|\bimg2mse\(|\bl2_loss\(|\) ?\*\* ?2\b|delta ?\*\* ?2", _SQUARED),
    (
        r"\bgetattr\(\w*loss\w*, ?\w|\b\w*Loss\w*\.L1\b|\w*loss\w*\[\w*(cfg|conf|opt|args)\w*\.",
        "the loss is chosen by a setting: name the line that calls it with --site",
    ),
    (
        r"loss_sds|\bsds_loss|guidance\w*(\.train_step)?\(",
        "the gradient is a diffusion model's (SDS), of no photograph",
    ),
)


def trained_instead(sources: Iterable[Source]) -> Iterator[str]:
    """Yield ``file:line: what`` for each row of the table that the files speak of, at its first line in code."""
    files = sorted(sources, key=lambda source: (source.path.count("/"), source.path))
    for pattern, what in _INSTEAD:
        found = ((source, hit) for source in files for hit in re.finditer(pattern, source.text, re.M))
        for source, hit in found:
            start = source.text.rfind("\n", 0, hit.start()) + 1
            line = source.text[start:].partition("\n")[0].lstrip()
            of_images = _OF_PICTURES.search(line) and "loss" in (line.replace(hit.group(), "") + source.path).lower()
            if not line.startswith(("#", "def ")) and (of_images or what is not _SQUARED):
                yield f"{source.path}:{source.text.count(chr(10), 0, hit.start()) + 1}: {what}"
                break
