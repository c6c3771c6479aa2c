"""FasterGSCudaBackend, the compiled backend of FasterGS (a method of NeRFICG), on the CPU.

Only its `_C` is replaced; its own Python stays in use. Gaussians come as they are optimised: logarithms of scales,
logits of opacities, quaternions of any length; pixel centres lie at +0.5. legs_loss's rasterizer draws them;
docs/cpu.md says where the two differ.
"""

from __future__ import annotations

import math
import types
from types import SimpleNamespace
from typing import Any, NamedTuple, Sequence, Tuple

import numpy as np
import torch
from torch import Tensor

from legs_adapters.shims.inria.relocation import relocated
from legs_adapters.shims.inria.survey import Interface
from legs_adapters.shims.missing import check_finite, complete
from legs_loss.lab.rasterizer import (
    MIN_ALPHA,
    NEAR,
    Drawn,
    Lens,
    Pinhole,
    Tensors,
    compensation,
    covariance,
    draw,
    rotations,
)

__all__ = ["module"]

BACKEND = "FasterGSCudaBackend"
SQUARE = math.sqrt(-2 * math.log(MIN_ALPHA)) + 0.01  # standard deviations: beyond them even opaque ones are not drawn
SMOOTHED = 0.1  # pixels^2: the dilation with proper antialiasing
MOST_SAMPLES = 50  # copies of one Gaussian in a relocation


class _Settings(NamedTuple):
    """The camera, in the order in which the backend's functions take it."""

    w2c: Tensor
    cam_position: Tensor
    bg_color: Tensor
    active_sh_bases: int
    width: int
    height: int
    focal_x: float
    focal_y: float
    center_x: float
    center_y: float
    near_plane: float
    far_plane: float
    proper_antialiasing: bool


class _Forward(NamedTuple):
    """The inputs of the backward pass; kept by the first of forward's buffers, and freed with it."""

    drawn: Drawn  # its image with the graph to `tensors`
    tensors: Tensors  # activated, and scaled by `size`
    size: float
    visible: Tensor  # bool [N]
    alphas: Tensor  # [N, 1], before antialiasing


def _draw(function: str, raw: Sequence[Tensor], settings: _Settings) -> _Forward:
    """Draw the six `raw` tensors; `function` is named in errors."""
    means, scales, quaternions, opacities, first, rest = (tensor.detach() for tensor in raw)
    named = dict(zip(("means", "scales", "rotations", "opacities", "sh_coefficients_0"), raw))
    check_finite(f"{BACKEND}._C.{function}", named)
    degree = round(int(settings.active_sh_bases) ** 0.5) - 1
    world_to_camera = np.eye(4)
    world_to_camera[:3] = settings.w2c.detach().to(torch.float64)[:3].numpy()
    axis = torch.from_numpy(world_to_camera[2]).to(means.dtype)
    depths = means @ axis[:3] + axis[3]
    inside = (depths >= settings.near_plane) & (depths <= settings.far_plane)

    # The rasterizer's near plane is fixed: scale the world by the ratio of the two instead.
    size = NEAR / float(settings.near_plane)
    world_to_camera[:3, 3] *= size
    view = Pinhole.from_camera(
        SimpleNamespace(
            width=settings.width,
            height=settings.height,
            fx=settings.focal_x,
            fy=settings.focal_y,
            cx=settings.center_x,
            cy=settings.center_y,
            world_to_camera=world_to_camera,
        )
    )
    means, scales, alphas = means * size if size != 1 else means.clone(), scales.exp().mul_(size), opacities.sigmoid()
    shown, lens = alphas * inside[:, None], Lens(square=SQUARE)
    if settings.proper_antialiasing:
        lens = lens._replace(dilation=SMOOTHED)
        shapes = covariance(scales.double(), quaternions.double())
        shown *= compensation(means.double(), shapes, view, SMOOTHED, least=0).to(shown.dtype)
    tensors = Tensors(
        means=means,
        scales=scales,
        quaternions=quaternions,
        opacities=shown,
        sh=torch.cat([first, rest[:, : (degree + 1) ** 2 - 1]], 1),
        colours=None,
        viewspace=torch.zeros(len(means), 2),
    )
    for tensor in tensors:
        if tensor is not None:
            tensor.requires_grad_()
    with torch.enable_grad():
        drawn = draw(tensors, view, settings.bg_color, degree, lens)
    return _Forward(drawn, tensors, size, drawn.reaching(), alphas)


def forward(*arguments: Any) -> Tuple[Tensor, Tensor, Tensor, Tensor, Tensor, int, int, int]:
    """Return the image [3, H, W], four buffers and three numbers for `backward`.

    Args:
        arguments: means [N, 3], logarithms of scales [N, 3], quaternions wxyz [N, 4], logits of opacities [N, 1], the
            first spherical harmonic [N, 1, 3] and the rest [N, K, 3]; then the settings' thirteen fields.
    """
    kept = _draw("forward", arguments[:6], _Settings(*arguments[6:]))
    buffers = [torch.empty(0, dtype=torch.uint8) for _ in range(4)]
    buffers[0].kept = kept  # type: ignore[attr-defined]
    return (kept.drawn.image.detach(), *buffers, int(kept.visible.sum()), 0, 0)  # type: ignore[return-value]


def backward(densification_info: Tensor, grad_image: Tensor, *arguments: Any) -> Tuple[Tensor, ...]:
    """Return the gradients of forward's six tensors; `densification_info` [2, N], unless empty, is added to in place.

    Its first row counts the views that show a Gaussian; its second sums the length of the gradient by the centre in
    pixels times half the image's size.
    """
    kept: _Forward = arguments[6].kept
    tensors = kept.tensors
    inputs = [tensor for tensor in tensors if tensor is not None]
    gradients = torch.autograd.grad(kept.drawn.image, inputs, grad_image)
    means, scales, quaternions, opacities, sh, viewspace = gradients
    if len(densification_info):
        densification_info[0] += kept.visible.to(densification_info.dtype)
        densification_info[1] += viewspace.norm(dim=1)
    rest = sh[:, 1:].contiguous()
    if rest.shape != arguments[5].shape:  # harmonics that are not in use yet
        rest = torch.nn.functional.pad(rest, (0, 0, 0, arguments[5].shape[1] - rest.shape[1]))
    assert tensors.scales is not None
    # As upstream: the gradient does not go through the factor by which antialiasing lowers an opacity.
    return (
        means * kept.size,
        scales * tensors.scales.detach(),
        quaternions,
        opacities * tensors.opacities.detach() * (1 - kept.alphas),
        sh[:, :1].contiguous(),
        rest,
    )


def inference(*arguments: Any) -> Tensor:
    """Return an image without gradients; then: whether [3, H, W] or [H, W, 3], whether clamped."""
    to_chw, clamp_output = arguments[19:]
    image = _draw("inference", arguments[:6], _Settings(*arguments[6:19])).drawn.image.detach()
    image = image.clamp(0, 1) if clamp_output else image
    return image if to_chw else image.permute(1, 2, 0).contiguous()


def pruning_scores(scores: Tensor, *arguments: Any) -> None:
    """Add to `scores` [N], in place, the dependence of an image on each Gaussian; then `forward`'s arguments.

    That is, the sum over pixels of the squared derivative of the sum of their channels by the Gaussian's falloff there.
    Source: Speedy-Splat (Hanson et al. 2025).
    """
    drawn = _draw("pruning_scores", arguments[:6], _Settings(*arguments[6:])).drawn
    scores.view(-1).add_(drawn.squared_slopes(torch.ones_like(drawn.image)).to(scores.dtype))


@torch.no_grad()
def adam_step(
    param_grad: Tensor,
    param: Tensor,
    exp_avg: Tensor,
    exp_avg_sq: Tensor,
    step_count: int,
    learning_rate: float,
    beta1: float,
    beta2: float,
    epsilon: float,
) -> None:
    """Do one step of Adam, in place, of float tensors of one shape; the moments and the parameter contiguous."""
    exp_avg.lerp_(param_grad, 1 - beta1)
    exp_avg_sq.mul_(beta2).addcmul_(param_grad, param_grad, value=1 - beta2)
    rate, correction = learning_rate / (1 - beta1**step_count), (1 - beta2**step_count) ** -0.5
    param.addcdiv_(exp_avg, exp_avg_sq.sqrt().mul_(correction).add_(epsilon), value=-rate)


@torch.no_grad()
def update_3d_filter(
    positions: Tensor,
    w2c: Tensor,
    filter_3d: Tensor,
    visibility_mask: Tensor,
    width: int,
    height: int,
    focal_x: float,
    focal_y: float,
    center_x: float,
    center_y: float,
    near_plane: float,
    clipping_tolerance: float,
    distance2filter: float,
) -> None:
    """Lower `filter_3d` [N, 1] to a view's pixel size at each point that it shows, and set its `visibility_mask`."""
    x, y, z = (positions @ w2c[:3, :3].T + w2c[:3, 3]).unbind(1)
    wide, tall = (clipping_tolerance + 0.5) * width, (clipping_tolerance + 0.5) * height
    shift_x, shift_y = center_x - 0.5 * width, center_y - 0.5 * height
    shown = (z >= near_plane) & (x >= (-wide - shift_x) / focal_x * z) & (x <= (wide - shift_x) / focal_x * z)
    shown &= (y >= (-tall - shift_y) / focal_y * z) & (y <= (tall - shift_y) / focal_y * z)
    size = distance2filter * z
    flat, mask = filter_3d.view(-1), visibility_mask.view(-1)
    shown &= flat >= size
    flat[shown] = size[shown]
    mask[shown] = True


@torch.no_grad()
def relocation_adjustment(old_opacities: Tensor, old_scales: Tensor, counts: Tensor) -> Tuple[Tensor, Tensor]:
    """Return opacities [N, 1] and scales [N, 3] at which `counts` [N] copies look like one Gaussian."""
    new, ratio = relocated(old_opacities.reshape(-1), counts.reshape(-1).clamp(1, MOST_SAMPLES))
    return new[:, None], ratio[:, None] * old_scales


@torch.no_grad()
def add_noise(
    raw_scales: Tensor,
    raw_rotations: Tensor,
    raw_opacities: Tensor,
    random_samples: Tensor,
    means: Tensor,
    current_lr: float,
) -> None:
    """Move `means` [N, 3], in place, by samples [N, 3] from each Gaussian, larger for fainter ones."""
    axes = rotations(raw_rotations)
    along = (axes.transpose(1, 2) @ random_samples[:, :, None]) * (2 * raw_scales).exp()[:, :, None]
    moved = (axes @ along)[:, :, 0]
    faint = torch.sigmoid(0.5 - 100 * torch.sigmoid(raw_opacities))
    drawn = (raw_rotations * raw_rotations).sum(1, keepdim=True) >= 1e-8
    means += torch.where(drawn, current_lr * faint * moved, torch.zeros_like(moved))


def module(name: str, interface: Interface) -> types.ModuleType:
    """Return the backend's package with its ``_C``."""
    functions = (
        forward,
        backward,
        inference,
        pruning_scores,
        adam_step,
        update_3d_filter,
        relocation_adjustment,
        add_noise,
    )
    return complete(name, __doc__, complete(f"{name}._C", None, *functions))
