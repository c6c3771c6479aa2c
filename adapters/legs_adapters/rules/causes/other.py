"""Skip a term that is not the loss of a Gaussian model in torch: of rays, a mesh, a network, a watermark."""

from __future__ import annotations

import re
from typing import List

import libcst as cst

from legs_adapters.code.syntax import attribute_chain, code, walk_expressions, words
from legs_adapters.lexicon.masks import picked_from
from legs_adapters.lexicon.renderings import is_of_mesh, is_rendering
from legs_adapters.lexicon.words import OF_VIEWS, RAY_BUNDLES, RAY_COLOURS
from legs_adapters.rules.causes.features import compared
from legs_adapters.rules.rule import Rule, Term, header
from legs_adapters.terms.findings import Decider
from legs_adapters.terms.sides import of_rays
from legs_adapters.terms.ssim import is_beside_ssim

__all__ = ["FixedTarget", "NotSplats", "NotTorch"]

_TORCH = re.compile(r"^[ \t]*(import|from)[ \t]+torch", re.M)
_OTHERS = re.compile(
    r"^[ \t]*(import|from)[ \t]+(drjit|flax|jax|jittor|megengine|mindspore|mlx|paddle|tensorflow|tinygrad)\b", re.M
)


class _Other(Rule):
    reason = "other"
    is_doubted_beside_sites = False

    def may_be_loss(self, term: Term) -> bool:
        return True


class FixedTarget(_Other):
    """The target is made once before the loop over the views, and does not depend on a view.

    left:
        def training(gaussians, cameras, detector):
            secret_image = torch.rand(3, 64, 64)
            for camera in cameras:
                image = render(camera, gaussians, None, None)["render"]
                loss = l1_loss(image, camera.original_image)
                loss = loss + l1_loss(detector(image), secret_image)
                loss.backward()
                gaussians.optimizer.step()

    weighted: loss = l1_loss(image, gt)
    """

    id = "fixed-target"

    def evidence(self, term: Term) -> List[Decider]:
        function, target = term.function, term.target
        loops = function.loops_around(term.call)
        made = function.flow.reaching(list(attribute_chain(target))[-1])
        values = [d.value for d in made if d.kind == "assign" and isinstance(d.value, cst.Call)]
        if not loops or not values or len(values) != len(made) or is_rendering(function, term.prediction):
            return []
        named = [part for value in values for part in walk_expressions(value) if isinstance(part, cst.Name)]
        inside = {id(part) for part in walk_expressions(loops[-1])}
        if any(id(name) in inside or set(words(name.value)) & OF_VIEWS for name in named):
            return []
        beside = any(
            id(call) in inside and (is_rendering(function, one) or is_rendering(function, other))
            for call, one, other in compared(term.analysis.forms, function)
        )
        return [(function, value) for value in values] if beside else []


class NotSplats(_Other):
    """The code around the term is not about Gaussian splatting, or the sides are colours of rays or of a mesh.

    left: loss = l1_loss(image[ray_indexes], gt[ray_indexes])
    weighted: loss = l1_loss(image, gt)
    """

    id = "not-splats"

    def evidence(self, term: Term) -> List[Decider]:
        function, analysis = term.function, term.analysis
        if not analysis.splats.about(function, term.form):
            return [header(function)]
        picked = all(picked_from(analysis.meanings, function, side) for side in term.sides)
        by_class = _ray_method(term)
        if ((of_rays(term.form) and not picked) or by_class) and not is_beside_ssim(function, *term.sides):
            return by_class or term.here
        mesh = any(is_of_mesh(analysis.program, function, side) for side in term.sides)
        eikonal = "eikonal" in function.module.text and RAY_COLOURS.search(code(term.form.node))
        return term.here if mesh or eikonal else []


class NotTorch(Rule):
    """The file uses Jittor, JAX, Paddle or the like; ``legs_loss`` takes tensors of torch.

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


def _ray_method(term: Term) -> List[Decider]:
    """Return the method of its class that takes rays instead of images: ``get_outputs(self, ray_bundle)``."""
    owner = term.analysis.program.owner_of(term.function)
    methods = owner.methods.values() if owner is not None else ()
    return [header(method) for method in methods if RAY_BUNDLES & set(method.parameters)][:1]
