"""Leave a term of a file that uses another framework than torch."""

from __future__ import annotations

import re
from typing import List

from legs_adapters.code.syntax import code
from legs_adapters.rules.rule import Rule, Term
from legs_adapters.terms.findings import Decider

__all__ = ["NotTorch"]

_TORCH = re.compile(r"^[ \t]*(import|from)[ \t]+torch", re.M)
_OTHERS = re.compile(
    r"^[ \t]*(import|from)[ \t]+(drjit|flax|jax|jittor|megengine|mindspore|mlx|paddle|tensorflow|tinygrad)\b", re.M
)


class NotTorch(Rule):
    """The file is of Jittor, JAX, Paddle or their like, and ``legs_loss`` takes torch's tensors.

    left:
        import jittor
        from gaussian_renderer import render
        from utils.loss_utils import l1_loss

        def training(gaussians, camera):
            image = render(camera, gaussians, None, None)["render"]
            loss = l1_loss(image, camera.original_image)
            loss.backward()
            gaussians.optimizer.step()

    weighted: loss = l1_loss(image, gt)
    """

    id = "not-torch"
    reason = "not torch"

    def evidence(self, term: Term) -> List[Decider]:
        module = term.function.module
        if _TORCH.search(module.text) or not _OTHERS.search(module.text):
            return []
        imports = [node for node in module.top.flow.imports if _OTHERS.search(code(node))]
        return [(module.top, node) for node in imports[:1]] or term.here
