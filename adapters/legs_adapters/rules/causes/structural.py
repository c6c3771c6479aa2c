"""Skip an SSIM that is not 3DGS's, or cannot be shown to be: legs-patch --ssim rewrites no other."""

from __future__ import annotations

from typing import List

from legs_adapters.code.syntax import arguments, constant
from legs_adapters.rules.rule import Rule, Term, header
from legs_adapters.tensors.steps import is_backward
from legs_adapters.terms.findings import Decider
from legs_adapters.terms.ssim import STRUCTURAL

__all__ = ["Definition", "Library", "Settings", "Twice", "Unproven"]


class Definition(Rule):
    """With `--ssim`: the call is in the body of the codebase's own SSIM, whose calls are decided one by one."""

    VALID = ["loss = 1.0 - ssim(image, gt)"]
    INVALID = [
        """
        def ssim_of_pair(image, gt):
            window = torch.tensor([0.2, 0.6, 0.2])
            return ssim(image, gt, window)
        """
    ]

    id = "ssim-definition"
    reason = "definition"

    def evidence(self, term: Term) -> List[Decider]:
        function, ssims = term.function, term.analysis.ssims
        if not STRUCTURAL.search(function.name) and not STRUCTURAL.search(term.class_name):
            return []
        inside = ssims.is_ssim(function) or ssims.proof(function, term.form).lack in ("settings", "unproven")
        return [header(function)] if inside else []


class _Lacking(Rule):
    """Skip an SSIM for the reason that its proof failed."""

    reason = "another SSIM"

    def evidence(self, term: Term) -> List[Decider]:
        proof = term.analysis.ssims.proof(term.function, term.form)
        return proof.deciders if f"ssim-{proof.lack}" == self.id else []


class Library(_Lacking):
    """With `--ssim`: the function is a library's (fused_ssim, torchmetrics), not the checkout's."""

    VALID = ["loss = 1.0 - ssim(image, gt)"]
    INVALID = [
        """
        import torch
        from fused_ssim import fused_ssim
        from gaussian_renderer import render
        from utils.loss_utils import l1_loss

        def training(gaussians, camera):
            image = render(camera, gaussians, None, None)["render"]
            loss = 1.0 - fused_ssim(image.unsqueeze(0), camera.original_image.unsqueeze(0))
            loss.backward()
            gaussians.optimizer.step()
        """
    ]

    id = "ssim-library"


class Settings(_Lacking):
    """With `--ssim`: the call has another window, a mask, one value per image, or an argument that is not a literal."""

    VALID = ["loss = 1.0 - ssim(image, gt, window_size=11)"]
    INVALID = ["loss = 1.0 - ssim(image, gt, window_size=7)"]

    id = "ssim-settings"


class Unproven(_Lacking):
    """With `--ssim`: the function is no known form of 3DGS's SSIM, or the source does not show which one is called."""

    VALID = ["loss = 1.0 - ssim(image, gt)"]
    INVALID = [
        """
        def ssim_of_patches(image, gt):
            return (image * gt).mean()

        def training(gaussians, camera):
            image = render(camera, gaussians, None, None)["render"]
            loss = 1.0 - ssim_of_patches(image, camera.original_image)
            loss.backward()
            gaussians.optimizer.step()
        """
    ]

    id = "ssim-unproven"
    reason = "unproven SSIM"


class Twice(Rule):
    """With `--ssim`: the loss is differentiated twice; `legs_loss.ssim` is differentiable once."""

    VALID = ["loss = 1.0 - ssim(image, gt)"]
    INVALID = [
        """
        loss = 1.0 - ssim(image, gt)
        torch.autograd.grad(loss, image, create_graph=True)
        """
    ]

    id = "ssim-twice"
    reason = "second derivative"

    def evidence(self, term: Term) -> List[Decider]:
        training, above = term.analysis.training, [term.function]
        for function in above:
            above += [caller for caller, _ in training.sites.get(function, ()) if caller not in above]
        modules = {function.module for function in above}
        passes = [(root, call) for root in training.roots if root.module in modules for call in root.flow.calls]
        passes = [(root, call) for root, call in passes if is_backward(call)]
        passes += [(term.function, call) for call in term.function.flow.calls]
        again: List[Decider] = []
        for function, call in passes:
            given = arguments(call)[1].get("create_graph")
            if given is not None and constant(given, True) is not False:
                again.append((function, call))
        return again[:1]
