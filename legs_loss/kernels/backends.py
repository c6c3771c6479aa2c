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
from legs_loss.kernels.contract import DeviceFault, Failed, NotNow, Prepared, Terms, node
from legs_loss.spec import WeightSpec
from legs_loss.weights import Weights

__all__ = ["Plan", "fused", "fused_range", "plan_of"]

_PLAIN = {Tensor, torch.nn.Parameter}  # what others mean by their values only they know
_TERMS = {"l1": Terms(1.0), "ssim": Terms(0.0, 1.0)}
_MOST = 256  # plans; a codebase with more shapes of images begins again


class Plan(NamedTuple):
    """A loss of two images, worked out.

    Attributes:
        layout: of the images as they were given.
        operation: "loss", "l1" or "ssim"; None is torch's.
        share: of D-SSIM in a "loss".
        spec: of the weights that are made from the target.
        prepared: the backend's; None where torch computes.
        makes: whether the backend makes the spec's weights by itself; else torch makes a map.
        moved: whether the images are not channels first as they are given.
        converted: whether they are converted to float32.
        plain: whether the loss is 3DGS's own, which torch computes, unless there is a map.
        place, found: where in BACKENDS what was found of the backend stands, and that: while it stands the plan holds.
    """

    layout: Layout
    operation: Optional[str] = None
    share: float = 0.0
    spec: Optional[WeightSpec] = None
    prepared: Optional[Prepared] = None
    makes: bool = False
    moved: bool = False
    converted: bool = False
    plain: bool = False
    place: Any = None
    found: Any = None


_plans: Dict[Any, Plan] = {}


def plan_of(
    operation: Optional[str],
    share: float,
    spec: Optional[WeightSpec],
    prediction: Tensor,
    target: Tensor,
    channels_last: Optional[bool] = None,
) -> Tuple[Plan, Tensor, Tensor]:
    """Return the plan of a loss, and its images as :func:`~legs_loss.images.read_pair` does, which checks them.

    Args:
        operation: None where torch is to compute, as in a graph that is compiled.
        share, spec: as in a Plan.
        prediction, target, channels_last: as for :func:`~legs_loss.legs_loss`.
    """
    if (
        operation is None
        or type(prediction) not in _PLAIN
        or type(target) not in _PLAIN
        or is_transformed()
        or is_wrapped(prediction)
        or is_wrapped(target)
        or target.requires_grad
    ):
        layout, prediction, target = read_pair(prediction, target, channels_last)
        return Plan(layout, spec=spec), prediction, target
    wanted, share = prediction.requires_grad and torch.is_grad_enabled(), float(share)  # a tensor's hash is its place
    given = (operation, share, spec, channels_last, wanted, BACKENDS.setting())
    one = (prediction.shape, prediction.stride(), prediction.dtype, prediction.device)
    key = (given, one, target.shape, target.stride(), target.dtype, target.device)
    plan = _plans.get(key)
    if plan is None or BACKENDS.found.get(plan.place) is not plan.found:
        layout, first, second = read_pair(prediction, target, channels_last)
        moved = first is not prediction or second is not target
        plan = _new_plan(Plan(layout, operation, share, spec, moved=moved), first, second, wanted)
        if plan.prepared is not None:
            if len(_plans) >= _MOST:
                _plans.clear()
            _plans[key] = plan
        return plan, first, second
    if plan.moved:
        return (plan, *read_pair(prediction, target, channels_last)[1:])
    return plan, prediction, target


def _new_plan(plan: Plan, prediction: Tensor, target: Tensor, wanted: bool) -> Plan:
    """Return a plan with what a backend prepares for images [C, H, W] or [B, C, H, W], if one takes them."""
    spec, operation, device = plan.spec, str(plan.operation), prediction.device
    backend = BACKENDS.ready(device, operation, spec)
    channels, height, width = prediction.shape[-3:]
    if (
        backend is None
        or operation not in backend.offers
        or channels > backend.most_channels
        or height * width > backend.most_pixels
        or not {prediction.dtype, target.dtype} <= backend.dtypes
    ):
        return plan
    makes = spec is not None and not spec.unweighted and backend.makes_weights_of(spec)
    converted = backend.converts(prediction, target)
    if converted:
        prediction, target = prediction.detach().float(), target.float()
    terms = _TERMS.get(operation) or Terms.of(plan.share)
    try:
        prepared = backend.prepare(terms, spec if makes else None, prediction, target, wanted)
    except Exception as error:
        _given_up(error, backend.name, device)
        return plan
    plain = operation == "loss" and (spec is None or spec.unweighted) and not forced_backend()
    place = BACKENDS.place(backend.name, device)
    return plan._replace(
        prepared=prepared, makes=makes, converted=converted, plain=plain, place=place, found=BACKENDS.found[place]
    )


def fused(plan: Plan, prediction: Tensor, target: Tensor, weights: Weights) -> Optional[Tensor]:
    """Return the loss that a plan is of, by its backend; None where torch computes it.

    Args:
        plan, prediction, target: of :func:`plan_of`; the prediction's hidden pixels may be the target's.
        weights: they may have a map in place of the plan's spec.
    """
    map_ = weights.map
    if plan.prepared is None or (plan.plain and map_ is None):
        return None  # unweighted it is 3DGS's own loss, bit-identical
    if map_ is not None and (type(map_) not in _PLAIN or map_.requires_grad or is_wrapped(map_)):
        return None
    if weights.spec is not plan.spec or weights.seen is not None:
        plan, prediction, target = plan_of(plan.operation, plan.share, weights.spec, prediction, target, False)
        if plan.prepared is None:
            return None
    if weights.spec is not None and not plan.makes:
        map_ = weights.with_map(target).map
    if plan.converted:
        prediction, target = prediction.float(), target.float()
    try:
        loss: Tensor = node(prediction, target, map_, weights.range, plan.prepared)
    except Failed as failed:
        _given_up(failed.__cause__, plan.place[0], prediction.device)
        return None
    return loss if weights.share is None else weights.of_what_counts(loss)


def fused_range(target: Tensor, spec: WeightSpec) -> Optional[Tensor]:
    """Return the range of a target, see :class:`~legs_loss.kernels.contract.Prepared`, [B, 2] (one image: [1, 2]).

    None where no backend makes the weights of this spec for this image by itself.
    """
    target = target.detach()
    plan, _, target = plan_of("l1", 0.0, spec, target, target, False)
    if not plan.makes or plan.prepared is None:
        return None
    try:
        return plan.prepared.response_range(target.float() if plan.converted else target)
    except Exception as error:
        _given_up(error, plan.place[0], target.device)
        return None


def _given_up(error: Optional[BaseException], name: str, device: torch.device) -> None:
    """Raise what a user or torch must know of; of others, as of a size that no trial covered, leave the backend."""
    if isinstance(error, (LegsError, MemoryError, OUT_OF_MEMORY, DeviceFault)):
        raise error from None  # what a node made of it says nothing more
    if isinstance(error, Exception) and not isinstance(error, NotNow):
        BACKENDS.give_up(name, device, error)
