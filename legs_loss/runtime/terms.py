"""Terms of a training step under the masks of a store; and SSIM, a drop-in for the ``ssim`` of 3DGS."""

from __future__ import annotations

import functools
from typing import NamedTuple, Optional, Union

import torch
from torch import Tensor

from legs_loss.config import is_off
from legs_loss.counting import counted
from legs_loss.images import Layout, check_order, is_compiling, is_trained, read_pair
from legs_loss.kernels.backends import fused_ssim
from legs_loss.runtime.sources import MASK
from legs_loss.runtime.state import current_run, refuse_masks, thread, version
from legs_loss.similarity import WINDOW_SIZE, ssim_map
from legs_loss.weights import Weights

__all__ = ["coverage", "masked", "ssim"]


def masked(prediction: Tensor, target: Tensor) -> Tensor:
    """Return the prediction with the pixels that the store's mask leaves out replaced by the target's.

    Written before the losses of a training step, it masks all of them, whatever computes them: where the mask is 0, no
    loss sees a difference, and the gradient of the prediction is exactly 0. Elsewhere, under a grey mask too, the
    prediction stays; ``l1_loss`` counts grey pixels in part. ``l1_loss`` and ``ssim`` are means over what counts; what
    else is a mean over the whole image is diluted: :func:`coverage`.

    Args:
        prediction: the rendering, as for :func:`l1_loss`.
        target: the photograph.

    Returns:
        The prediction's shape; the prediction itself, the same tensor, where no mask leaves anything out: no store with
        masks, LEGS_OFF, a prediction that is not trained on, a view without a mask.

    Raises:
        LegsError: as :func:`l1_loss`; with LEGS_MASKS=require a target that is not in the store.

    Examples:
        >>> image, gt_image = torch.rand(3, 8, 8, requires_grad=True), torch.rand(3, 8, 8)
        >>> masked(image, gt_image) is image
        True
    """
    step = _step(prediction, target)
    if step is None:
        return prediction
    counted.hidden += 1
    return step.layout.restored(step.weights.hidden(step.prediction, step.target)).reshape(prediction.shape)


def coverage(prediction: Tensor, target: Tensor) -> Union[Tensor, float]:
    """Return the share of the pixels that the store's mask does not leave out: what other terms are divided by.

    A term that is a mean over the whole image, of a rendering that :func:`masked` made, counts masked pixels as equal.
    ``term / coverage(image, gt_image)`` is its mean over what counts.

    Returns:
        A scalar tensor, or 1.0 where :func:`masked` changes nothing.

    Examples:
        >>> image, gt_image = torch.rand(3, 8, 8, requires_grad=True), torch.rand(3, 8, 8)
        >>> coverage(image, gt_image)
        1.0
    """
    step = _step(prediction, target)
    return 1.0 if step is None or step.weights.share is None else step.weights.share


def ssim(
    img1: Tensor,
    img2: Tensor,
    window_size: int = WINDOW_SIZE,
    size_average: bool = True,
    *,
    padding: str = "zeros",
    channels_last: Optional[bool] = None,
    mask: Optional[Tensor] = None,
) -> Tensor:
    """Return the mean structural similarity of two images, 1 for equal ones; a drop-in for the ``ssim`` of 3DGS.

    A Gaussian window of 11x11 and sigma 1.5, each channel by itself, C1 = 0.01^2, C2 = 0.03^2 (source: Inria's
    utils/loss_utils.py; Wang et al. 2004). Where neither image is trained on (``no_grad``, evaluation) it is 3DGS's own
    value, bit-identical. In a training step value and gradient come from a backend where one takes the images
    (docs/performance.md): equal up to rounding, differentiable once; with LEGS_OFF=1 they are 3DGS's own there, too.

    Args:
        img1: one of the two images, in either order, by 3DGS's names: floats in [0, 1], of one shape, [H, W],
            [C, H, W], [H, W, C] or batches of these; or an image beside a batch of one image, as 3DGS's takes them.
        img2: the other.
        window_size: the window's side in pixels, odd.
        size_average: the mean over all images; False is one value an image, [B].
        padding: "zeros" as in 3DGS's code, "reflect", "replicate", or "valid" (only windows inside the image).
        channels_last: where the channel stands, for a shape that does not show it.
        mask: one value a pixel, as for :func:`l1_loss`. The image that is trained on has the other's pixels where it is
            0, and 1 - SSIM is summed over the image and divided by the number of the others (docs/masks.md). So it is
            in a training step by a mask of the store.

    Returns:
        A scalar (or [B]), differentiable in both images. Half precision is computed in float32, with autocast off: the
        variances are differences of near-equal numbers.

    Raises:
        LegsError: the shapes differ or may be read either way, the padding is unknown, the window is even, or the image
            is too small for it; as :func:`masked`.

    Examples:
        >>> image = torch.rand(3, 16, 16)
        >>> round(float(ssim(image, image)), 5)
        1.0
    """
    layout, first, second = read_pair(img1, img2, channels_last)
    mask = layout.map_first(mask, second, "mask")
    first, second = layout.channels_first(first), layout.channels_first(second)
    swapped = not is_trained(first) and is_trained(second)
    trained, constant = (second, first) if swapped else (first, second)
    step = _step(trained, constant, channels_last=False)
    if step is not None and step.weights.seen is not None:
        counted.hidden += 1
        mask = step.weights.seen if mask is None else mask * step.weights.seen
    if mask is not None and trained.dim() == 4 and not size_average:
        masks = mask.expand(len(trained), *mask.shape[-3:])
        one_by_one = functools.partial(ssim, window_size=window_size, padding=padding, channels_last=False)
        return torch.stack([one_by_one(*images, mask=own) for *images, own in zip(first, second, masks)])
    weights = Weights().masked(mask)
    trained = weights.hidden(trained, constant)
    if window_size == WINDOW_SIZE and size_average and trained.requires_grad and torch.is_grad_enabled():
        fused = None if is_off() else fused_ssim(trained, constant, padding)
        if fused is not None:
            return _of_what_counts(fused, weights)
    first, second = (constant, trained) if swapped else (trained, constant)
    similarity = ssim_map(first, second, padding, False, window_size)
    similarity = similarity.mean() if size_average else similarity.mean(-3).mean(-2).mean(-1)
    return _of_what_counts(similarity, weights, window_size // 2 if padding == "valid" else 0)


def _of_what_counts(similarity: Tensor, weights: Weights, border: int = 0) -> Tensor:
    return similarity if weights.share is None else 1.0 - weights.of_what_counts(1.0 - similarity, border)


class _Step(NamedTuple):
    """The images of a step whose target has a mask in the store, [C, H, W] or [B, C, H, W], and what counts of them."""

    layout: Layout
    prediction: Tensor
    target: Tensor
    weights: Weights


def _step(prediction: Tensor, target: Tensor, channels_last: Optional[bool] = None) -> Optional[_Step]:
    if is_compiling():
        refuse_masks(version[0])
        return None
    if thread.unweighted or not (is_trained(prediction) or is_trained(target)):
        return None
    run = current_run()
    if run.config.off or not run.source.stored.has(MASK):
        return None
    check_order(prediction, target)
    layout, prediction, target = read_pair(prediction, target, channels_last)
    prediction, target = layout.channels_first(prediction), layout.channels_first(target)
    with torch.no_grad():
        mask = run.source.own(target, [None] * (len(target) if target.dim() == 4 else 1), MASK)
        weights = Weights().masked(mask)
    run.tell_at_end()
    if mask is None:
        return None
    return _Step(layout, prediction, target, weights)
