"""Other terms of a training step under the masks of a store: SSIM as 3DGS calls it, and the whole loss as a Module."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path
from typing import Optional, Tuple, Union

import torch
from torch import Tensor

from legs_loss.autograd import check_order, is_compiling, is_trained
from legs_loss.config import find_config, is_off, store_folder
from legs_loss.counting import counted
from legs_loss.images import Layout, read_pair
from legs_loss.kernels.backends import fused, plan_of
from legs_loss.kernels.contract import SSIM
from legs_loss.loss import legs_loss, total_loss, whole
from legs_loss.runtime import state
from legs_loss.runtime.state import MASK, TrainingRun, current_run, refuse_masks, thread
from legs_loss.similarity import WINDOW_SIZE, check_window, ssim_map
from legs_loss.spec import Spec, WeightSpec, as_spec
from legs_loss.weights import Weights


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
    layout, image, photograph, weights = step
    return layout.restored(weights.hidden(image, photograph)).reshape(prediction.shape)


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
    return 1.0 if step is None or step[-1].share is None else step[-1].share


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
    check_window(window_size, padding)
    layout, first, second = read_pair(img1, img2, channels_last)
    mask = layout.map_first(mask, second, "mask")
    swapped = not is_trained(first) and is_trained(second)
    trained, constant = (second, first) if swapped else (first, second)
    step = _step(trained, constant, channels_last=False)
    if step is not None and step[-1].seen is not None:
        counted.hidden += 1
        mask = step[-1].seen if mask is None else mask * step[-1].seen
    if mask is not None and trained.dim() == 4 and not size_average:
        masks = mask.expand(len(trained), *mask.shape[-3:])
        one_by_one = functools.partial(ssim, window_size=window_size, padding=padding, channels_last=False)
        return torch.stack([one_by_one(*images, mask=one) for *images, one in zip(first, second, masks)])
    weights = Weights().masked(mask)
    trained = weights.hidden(trained, constant)
    if window_size == WINDOW_SIZE and size_average and trained.requires_grad and torch.is_grad_enabled():
        by_torch = padding != "zeros" or is_compiling() or is_off()
        plan, _, _ = plan_of(None if by_torch else SSIM, None, trained, constant, False)
        similarity = fused(plan, trained, constant, Weights())
        if similarity is not None:
            return _of_what_counts(similarity, weights)
    first, second = (constant, trained) if swapped else (trained, constant)
    similarity = ssim_map(first, second, padding, False, window_size)
    similarity = similarity.mean() if size_average else similarity.mean(-3).mean(-2).mean(-1)
    return _of_what_counts(similarity, weights, window_size // 2 if padding == "valid" else 0)


class LEGSLoss(torch.nn.Module):
    """:func:`~legs_loss.legs_loss` as a Module: settings at construction, images at each call.

    A spec that is normalised over the scene needs the store that has its levels.

    Args:
        spec: as for :func:`~legs_loss.legs_loss`, like the others.
        lambda_dssim: the share of D-SSIM.
        padding: of SSIM.
        renormalise: make both terms the mean over what a ``mask`` counts.
        channels_last: where the channel stands, for shapes that do not show it.
        store: a folder that ``legs precompute`` wrote: its maps are used for exactly the images that they belong to.
            With masks in it both terms are the mean over what counts, and an image that is not found is said, or with
            LEGS_MASKS=require an error (docs/masks.md).

    Shape:
        prediction, target: [H, W], [C, H, W], [H, W, C] or batches; weight, mask: one value a pixel; output: a scalar.

    Examples:
        >>> criterion = LEGSLoss("legs-l")
        >>> target = torch.rand(3, 16, 16)
        >>> criterion(target, target) < 1e-6
        tensor(True)
    """

    def __init__(
        self,
        spec: Spec = "legs",
        lambda_dssim: float = 0.2,
        padding: str = "zeros",
        renormalise: bool = False,
        channels_last: Optional[bool] = None,
        store: Union[str, Path, None] = None,
    ) -> None:
        super().__init__()
        self.spec: WeightSpec = as_spec(spec)
        self.lambda_dssim = lambda_dssim
        self.padding = padding
        self.renormalise = renormalise
        self.channels_last = channels_last
        self._run: Optional[TrainingRun] = None
        whole(lambda_dssim, padding)  # checks them
        folder = store_folder(store, Path())
        if folder is not None:
            config = replace(find_config(None, argv=[]), spec=self.spec, preset="LEGSLoss", source="LEGSLoss()")
            self._run = TrainingRun(replace(config, store=folder))

    def forward(
        self, prediction: Tensor, target: Tensor, weight: Optional[Tensor] = None, mask: Optional[Tensor] = None
    ) -> Tensor:
        """Return the loss; see :func:`~legs_loss.legs_loss`."""
        if self._run is not None and weight is None:
            return self._by_store(self._run, prediction, target, mask)
        settings = (self.lambda_dssim, self.padding, self.renormalise, self.channels_last)
        return legs_loss(prediction, target, self.spec, weight, mask, *settings)

    def _by_store(self, run: TrainingRun, prediction: Tensor, target: Tensor, mask: Optional[Tensor]) -> Tensor:
        share, terms = self.lambda_dssim, whole(self.lambda_dssim, self.padding)
        plan, image, photograph = plan_of(terms, self.spec, prediction, target, self.channels_last)
        check_order(image, photograph)
        weights = run.weights(photograph, None, plan.makes)
        counted.hidden += weights.share is not None
        mask = plan.layout.map_first(mask, photograph, "mask")
        weights = weights.masked(mask, self.renormalise and weights.share is None)
        run.say_what_is_used()
        made = "" if weights.map is None and self.spec.unweighted else "by LEGSLoss"
        return total_loss(plan, image, photograph, weights, share, self.padding, made)

    def extra_repr(self) -> str:
        """Return the settings, for ``print(module)``."""
        return f"{self.spec}, lambda_dssim={self.lambda_dssim}, padding={self.padding!r}"


def _of_what_counts(similarity: Tensor, weights: Weights, border: int = 0) -> Tensor:
    return similarity if weights.share is None else 1.0 - weights.of_what_counts(1.0 - similarity, border)


def _step(
    prediction: Tensor, target: Tensor, channels_last: Optional[bool] = None
) -> Optional[Tuple[Layout, Tensor, Tensor, Weights]]:
    """Return of a step whose target has a mask in the store the layout, the images as [B, C, H, W], and what counts."""
    if is_compiling():
        refuse_masks(state.generation)
        return None
    if not (isinstance(prediction, Tensor) and isinstance(target, Tensor)):
        read_pair(prediction, target)  # the error names which
    if thread.unweighted or not (is_trained(prediction) or is_trained(target)):
        return None
    run = current_run()
    if run.config.off or not run.stored.has(MASK):
        return None
    check_order(prediction, target)
    layout, prediction, target = read_pair(prediction, target, channels_last)
    with torch.no_grad():
        mask = run.users_map(target, MASK)
        weights = Weights().masked(mask)
    run.tell_at_end()
    return None if mask is None else (layout, prediction, target, weights)
