"""The plan of a loss: what hangs on shapes, types, device and settings alone, worked out once and kept.

A step looks its plan up, and launches. A plan is kept for a backend's losses only: torch has no need of one.
"""

from __future__ import annotations

from typing import Any, Dict, NamedTuple, Optional, Tuple

import torch
from torch import Tensor

from legs_loss.autograd import is_transformed, is_wrapped
from legs_loss.errors import LegsError
from legs_loss.images import Layout, read_pair
from legs_loss.kernels.available import BACKENDS, OUT_OF_MEMORY, forced_backend
from legs_loss.kernels.contract import L1, DeviceFault, Failed, NotNow, PreparedLoss, Terms, node
from legs_loss.spec import WeightSpec
from legs_loss.weights import Weights

_PLAIN = {Tensor, torch.nn.Parameter}  # what others mean by their values only they know
_FLAGS = {bool, type(None)}
_MOST = 256  # plans; a codebase with more shapes of images begins again


class LossPlan(NamedTuple):
    """A loss of two images, worked out.

    Attributes:
        layout: of the images as they were given.
        terms: of the loss; None is torch's.
        spec: of the weights that are made from the target.
        prepared: the backend's; None where torch computes.
        makes: whether the backend makes the spec's weights by itself; else torch makes a map.
        moved: whether the images are not channels first as they are given.
        plain: whether the loss is 3DGS's own, which torch computes, unless there is a map.
        place, found: where in BACKENDS what was found of the backend stands, and that: while it stands the plan holds.
    """

    layout: Layout
    terms: Optional[Terms] = None
    spec: Optional[WeightSpec] = None
    prepared: Optional[PreparedLoss] = None
    makes: bool = False
    moved: bool = False
    plain: bool = False
    place: Any = None
    found: Any = None


_plans: Dict[Any, LossPlan] = {}


def plan_of(
    terms: Optional[Terms],
    spec: Optional[WeightSpec],
    prediction: Tensor,
    target: Tensor,
    channels_last: Optional[bool] = None,
) -> Tuple[LossPlan, Tensor, Tensor]:
    """Return the plan of a loss, and its images as :func:`~legs_loss.images.read_pair` does, which checks them.

    Args:
        terms: None where torch is to compute, as in a graph that is compiled.
        spec: as in a LossPlan.
        prediction, target, channels_last: as for :func:`~legs_loss.legs_loss`.
    """
    if (
        terms is None
        or type(prediction) not in _PLAIN
        or type(target) not in _PLAIN
        or type(channels_last) not in _FLAGS
        or is_transformed()
        or is_wrapped(prediction)
        or is_wrapped(target)
        or prediction.is_neg()  # their memory has other values
        or target.is_neg()
        or target.requires_grad
        or not (prediction.layout is target.layout is torch.strided)
    ):
        layout, prediction, target = read_pair(prediction, target, channels_last)
        return LossPlan(layout, spec=spec), prediction, target
    wanted = prediction.requires_grad and torch.is_grad_enabled()
    given = (terms, spec, channels_last, wanted, BACKENDS.setting())
    one = (prediction.shape, prediction.stride(), prediction.dtype, prediction.device)
    key = (given, one, target.shape, target.stride(), target.dtype, target.device)
    plan = _plans.get(key)
    if plan is None or BACKENDS.found.get(plan.place) is not plan.found:
        layout, first, second = read_pair(prediction, target, channels_last)
        moved = first is not prediction or second is not target
        plan = _new_plan(LossPlan(layout, terms, spec, moved=moved), terms, first, second, wanted)
        if plan.prepared is not None:
            if len(_plans) >= _MOST:
                _plans.clear()
            _plans[key] = plan
        return plan, first, second
    if plan.moved:
        return (plan, *read_pair(prediction, target, channels_last)[1:])
    return plan, prediction, target


def _new_plan(plan: LossPlan, terms: Terms, prediction: Tensor, target: Tensor, wanted: bool) -> LossPlan:
    """Return a plan with what a backend prepares for images [C, H, W] or [B, C, H, W], if one takes them."""
    spec, device = plan.spec, prediction.device
    backend = BACKENDS.ready(device, terms.name, spec)
    channels, height, width = prediction.shape[-3:]
    if (
        backend is None
        or channels > backend.most_channels
        or height * width > backend.most_pixels
        or not {prediction.dtype, target.dtype} <= backend.dtypes
    ):
        return plan
    makes = spec is not None and not spec.unweighted and backend.makes_weights_of(spec)
    try:
        prepared = backend.prepare(terms, spec if makes else None, prediction, target, wanted)
    except Exception as error:
        _given_up(error, device)
        return plan
    plain = terms.constant > 0.0 and (spec is None or spec.unweighted) and not forced_backend()
    place = BACKENDS.place(device)
    return plan._replace(prepared=prepared, makes=makes, plain=plain, place=place, found=BACKENDS.found[place])


def fused(plan: LossPlan, prediction: Tensor, target: Tensor, weights: Weights) -> Optional[Tensor]:
    """Return the loss that a plan is of, by its backend; None where torch computes it.

    Args:
        plan, prediction, target: of :func:`plan_of`; the prediction's hidden pixels may be the target's.
        weights: they may have a map in place of the plan's spec.
    """
    map_ = weights.map
    if plan.prepared is None or (plan.plain and map_ is None):
        return None  # unweighted it is 3DGS's own loss, bit-identical
    if map_ is not None and (type(map_) not in _PLAIN or map_.requires_grad or is_wrapped(map_) or map_.is_neg()):
        return None
    if weights.spec is not plan.spec or weights.seen is not None:
        plan, prediction, target = plan_of(plan.terms, weights.spec, prediction, target, False)
        if plan.prepared is None:
            return None
    if weights.spec is not None and not plan.makes:
        map_ = weights.with_map(target).map
    try:
        loss: Tensor = node(prediction, target, map_, weights.range, plan.prepared)
    except Failed as failed:
        _given_up(failed.__cause__, prediction.device)
        return None
    return loss if weights.share is None else weights.of_what_counts(loss)


def fused_range(target: Tensor, spec: WeightSpec) -> Optional[Tensor]:
    """Return the range of a target, see :class:`~legs_loss.kernels.contract.PreparedLoss`, [B, 2] (one image: [1, 2]).

    None where no backend makes the weights of this spec for this image by itself.
    """
    target = target.detach()
    plan, _, target = plan_of(L1, spec, target, target, False)
    if not plan.makes or plan.prepared is None:
        return None
    try:
        return plan.prepared.response_range(target)
    except Exception as error:
        _given_up(error, target.device)
        return None


def _given_up(error: Optional[BaseException], device: torch.device) -> None:
    """Raise what a user or torch must know of; of others, as of a size that no trial covered, leave the backend."""
    if isinstance(error, (LegsError, MemoryError, OUT_OF_MEMORY, DeviceFault)):
        raise error from None  # what a node made of it says nothing more
    if isinstance(error, Exception) and not isinstance(error, NotNow):
        BACKENDS.give_up(device, error)
