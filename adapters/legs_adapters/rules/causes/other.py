"""Skip a term that is not about Gaussian splatting: of rays, a mesh, another network."""

from __future__ import annotations

import re
from typing import List

from legs_adapters.lexicon.masks import picked_from
from legs_adapters.lexicon.words import RAY_BUNDLES
from legs_adapters.rules.rule import Rule, Term, header
from legs_adapters.terms.findings import Decider
from legs_adapters.terms.sides import of_rays
from legs_adapters.terms.ssim import is_beside_ssim

__all__ = ["NotSplats"]

_TORCH = re.compile(r"^[ \t]*(import|from)[ \t]+torch", re.M)
_OTHER_FRAMEWORK = re.compile(
    r"^[ \t]*(import|from)[ \t]+(drjit|flax|jax|jittor|megengine|mindspore|mlx|paddle|tensorflow|tinygrad)\b", re.M
)


class NotSplats(Rule):
    """The code around the term is not about Gaussian splatting in torch, or the sides are colours of rays."""

    id = "not-splats"
    reason = "other"
    is_doubted_beside_sites = False
    VALID = ["loss = l1_loss(image, gt)"]
    INVALID = ["loss = l1_loss(image[ray_indexes], gt[ray_indexes])"]

    def evidence(self, term: Term) -> List[Decider]:
        function, analysis = term.function, term.analysis
        if _OTHER_FRAMEWORK.search(function.module.text) and not _TORCH.search(function.module.text):
            return term.here
        if not analysis.splats.about(function, term.form):
            return [header(function)]
        picked = all(picked_from(analysis.meanings, function, side) for side in term.sides)
        by_class = _ray_method(term)
        rays = (of_rays(term.form) and not picked) or by_class
        return (by_class or term.here) if rays and not is_beside_ssim(function, *term.sides) else []

    def may_be_loss(self, term: Term) -> bool:
        return True


def _ray_method(term: Term) -> List[Decider]:
    """Return the method of its class that takes rays instead of images: ``get_outputs(self, ray_bundle)``."""
    owner = term.analysis.program.owner_of(term.function)
    methods = owner.methods.values() if owner is not None else ()
    return [header(method) for method in methods if RAY_BUNDLES & set(method.parameters)][:1]
