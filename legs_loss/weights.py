"""The weight map of a photograph, W = 1 + beta * f(E^); and what a pixel counts in a loss: the one algebra of weights.

With a weight W (a preset's map, times the user's), a mask M in [0, 1], the rendering U and the photograph F:

    L1     = sum(M * W * |U - F|) / sum(M)
    D-SSIM = sum(1 - SSIM(U', F)) / number of pixels with M > 0        U' = U where M > 0, F elsewhere

so a pixel that does not count has no gradient, and dilutes neither term. Both are the mean over the whole image, of U'
and with the map W * M * s / mean(M), divided by s, the share of the pixels with M > 0. So no backend knows of masks.
"""

from __future__ import annotations

from typing import NamedTuple, Optional

import torch
from torch import Tensor

from legs_loss.autograd import is_compiling, is_transformed
from legs_loss.curves import curve
from legs_loss.errors import LegsError
from legs_loss.images import check_values, read_layout
from legs_loss.responses import normalise_response, over_scene, percentile, response
from legs_loss.spec import Spec, WeightSpec, as_spec


def weight_map(
    image: Tensor, spec: Spec = "legs", channels_last: Optional[bool] = None, scene: Optional[Tensor] = None
) -> Tensor:
    """Return the weight map of a training image.

    Args:
        image: the photograph as the training uses it, floats in [0, 1], [H, W], [C, H, W], [H, W, C], or a batch.
        spec: a preset's name or a :class:`~legs_loss.WeightSpec`.
        channels_last: where the channel stands, for a shape that does not show it.
        scene: for a spec that is normalised over the scene its levels, [2], as :func:`legs_loss.responses.scene_levels`
            returns them; without them the images of this call are the scene.

    Returns:
        The image's shape with one channel, in [1, 1 + beta] (with ``normalise="mean"``: of mean 1), float32
        (float64 for float64). It carries no gradient. A constant image gets 1 everywhere.

    Raises:
        LegsError: not an image, one whose channel may be first or last, or (on the CPU) values that are NaN, infinite
            or plainly of 0..255. On other devices the values are not checked, since that would wait for the device: a
            NaN in the image makes the whole map NaN instead.

    Source: the LEGS paper, its weighted loss; the reflected border and the constant image are this project's choice.

    Examples:
        >>> dot = torch.zeros(2, 5)
        >>> dot[0, 2] = 1.0
        >>> weight_map(dot, "legs-l")
        tensor([[ 1.0000,  3.5000, 11.0000,  3.5000,  1.0000],
                [ 1.0000,  1.0000,  6.0000,  1.0000,  1.0000]])
    """
    spec = as_spec(spec)
    if scene is not None and not (isinstance(scene, Tensor) and scene.shape == (2,)):
        raise LegsError(f"scene must be a tensor of two levels, as of scene_levels, got {scene!r}")
    layout = read_layout(image, channels_last)
    if image.device.type == "cpu" and not (is_compiling() or is_transformed()):
        check_values(image, "image")
    strength = response(layout.channels_first(image), spec.operator, spec.p, False, spec.smooth)
    if spec.over == "scene":
        return layout.restored(weight_over_scene(strength, spec, scene))
    return layout.restored(weight_from_response(normalise_response(strength, spec.eps), spec))


def weight_over_scene(strength: Tensor, spec: WeightSpec, scene: Optional[Tensor] = None) -> Tensor:
    """Return the weight map of a response E that is to be normalised over its scene (``over="scene"``).

    Args:
        strength: E, not normalised, [1, H, W] or [B, 1, H, W] (or channels-last), any float type.
        spec: its operator, p and smooth are those that E was made with.
        scene: the scene's levels, [2]; without them these images are the scene.

    Returns:
        The same shape, float32 (float64 for float64).
    """
    return curved(over_scene(_floats(strength), spec, scene), spec)


def weight_from_response(normalised: Tensor, spec: Spec = "legs") -> Tensor:
    """Return the weight map of a normalised response, computed now or read from a store.

    Args:
        normalised: E^ in [0, 1], [1, H, W] or [B, 1, H, W] (or channels-last), any float type.
        spec: a preset's name or a spec; its operator, p and smooth are those that E^ was made with.

    Returns:
        The same shape, float32 (float64 for float64).

    Raises:
        LegsError: the spec normalises over the scene, and E^ is normalised by itself.

    Examples:
        >>> weight_from_response(torch.tensor([[[0.0, 0.25, 1.0]]]), "legs")
        tensor([[[ 1.,  6., 11.]]])
    """
    spec = as_spec(spec)
    if spec.over == "scene":
        raise LegsError('E^ is normalised by itself: a spec with over="scene" needs weight_over_scene')
    normalised = _floats(normalised)
    if spec.percentile < 100.0:
        strong = percentile(normalised, spec.percentile)
        normalised = (normalised / (strong.reshape(*strong.shape, 1, 1, 1) + spec.eps)).clamp(max=1.0)
    return curved(normalised, spec)


def curved(normalised: Tensor, spec: WeightSpec) -> Tensor:
    """Return the weight map of a response that is normalised and clamped already, by the spec."""
    weight = (spec.beta * curve(spec.curve)(normalised)).add_(1.0)
    if spec.normalise == "mean":
        weight = weight / weight.mean((-3, -2, -1), keepdim=True)
    return weight


class Weights(NamedTuple):
    """Weights of the pixels of a target: the product of what is given, 1 where nothing is. It carries no gradient.

    Attributes:
        spec: a factor that is made from the target by this spec.
        range: what :meth:`Backend.response_range` returned for these targets and this spec, [B, 2]. Without it a
            backend makes it, in a pass of its own over the target.
        map: the product of all other factors, floats, [1, H, W] or [B, 1, H, W].
        seen: bool, in the same shapes: the pixels that count at all. None where all do.
        share: a scalar tensor, the share of these, that the loss is divided by; None where it is not.
    """

    spec: Optional[WeightSpec] = None
    range: Optional[Tensor] = None
    map: Optional[Tensor] = None
    seen: Optional[Tensor] = None
    share: Optional[Tensor] = None

    def times(self, factor: Optional[Tensor]) -> Weights:
        """Return these weights times a map."""
        if factor is None:
            return self
        return self._replace(map=_floats(factor) if self.map is None else self.map * factor)

    def masked(self, mask: Optional[Tensor], renormalise: bool = True) -> Weights:
        """Return these weights times a mask, bool or floats in [0, 1]; with ``renormalise`` losses are of what counts.

        Where nothing counts, the loss is 0.
        """
        if mask is None:
            return self
        mask, seen = _floats(mask), mask > 0
        both = seen if self.seen is None else seen & self.seen
        if not renormalise:
            return self.times(mask)._replace(seen=both)
        share, covered = _share(seen).to(mask.dtype), mask.mean().clamp(min=torch.finfo(mask.dtype).tiny)
        return self.times(mask * (share / covered))._replace(seen=both, share=share)

    def with_map(self, target: Tensor) -> Weights:
        """Return these weights with the spec's factor in their map; target [C, H, W] or [B, C, H, W]."""
        made = None if self.spec is None or self.spec.beta == 0.0 else weight_map(target, self.spec, False)
        return self._replace(spec=None, range=None).times(made)

    def hidden(self, prediction: Tensor, target: Tensor) -> Tensor:
        """Return the prediction with the target's pixels where nothing counts; the very tensor without a mask."""
        return prediction if self.seen is None else torch.where(self.seen, prediction, target.to(prediction.dtype))

    def of_what_counts(self, values: Tensor, border: int = 0) -> Tensor:
        """Return the loss of a mean over the whole image, or a weight map as such a mean needs it.

        Args:
            values: either of them.
            border: how many pixels on each side the mean leaves out.
        """
        if self.seen is None or self.share is None:
            return values
        share = self.share if border == 0 else _share(self.seen[..., border:-border, border:-border])
        return values / share.to(values.dtype)

    def mean_weight(self) -> float:
        """Return the mean of the map over what counts; 1 without one."""
        return 1.0 if self.map is None else float(self.of_what_counts(self.map.double().mean()))


def _share(seen: Tensor) -> Tensor:
    """Return the share of the pixels that count; 1 where none does, so that their loss is 0."""
    share = seen.to(torch.float32).mean()
    return torch.where(share > 0, share, torch.ones_like(share))


def _floats(values: Tensor) -> Tensor:
    return values.to(torch.promote_types(values.dtype, torch.float32))
