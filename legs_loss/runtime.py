"""What a training script talks to: ``l1_loss``, in place of the codebase's own.

It weights only a prediction that is being trained on; under ``no_grad`` it is the plain mean, so that reported metrics
do not change. Where the weight comes from, in this order:

1. the memo, for a target it can prove to be the same as before;
2. the store, for a named view whose target has the fingerprint of the image that the stored map was made from;
3. the target itself.
"""

from __future__ import annotations

import sys
import threading
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Callable, List, Optional, Sequence, Set, Tuple, TypeVar, Union

import torch
from torch import Tensor

from legs_loss.config import Config, find_config
from legs_loss.distributed import is_first_process
from legs_loss.errors import LegsError
from legs_loss.images import as_map, check_pair, is_compiling
from legs_loss.loss import weighted_l1
from legs_loss.memo import DEFAULT_LIMIT, WeightMemo
from legs_loss.response import normalise_response, response
from legs_loss.spec import Spec, as_spec
from legs_loss.weights import error_weight_map, weight_from_response, weight_map

if TYPE_CHECKING:
    from legs_loss.store import WeightStore

__all__ = ["Counts", "active", "configure", "counts", "l1_loss", "unweighted"]

View = Union[str, int, Sequence[Union[str, int]], None]
Own = Callable[[Tensor, Tensor], Tensor]
Result = TypeVar("Result")


@dataclass
class Counts:
    """How often ``l1_loss`` was called in this process, and where its weights came from.

    Attributes:
        weighted: calls that trained with a weight.
        plain: calls that returned the plain mean: no gradient asked for, beta 0, LEGS_OFF, or `unweighted`.
        remembered: weight maps taken from the memo, per view.
        stored: weight maps taken from the store.
        computed: weight maps computed from their target.
    """

    weighted: int = 0
    plain: int = 0
    remembered: int = 0
    stored: int = 0
    computed: int = 0


class _Run:
    """The state of this process's run: its settings, once found; its memo and its store."""

    def __init__(self, config: Config, memo_bytes: int = DEFAULT_LIMIT) -> None:
        self.config = config
        self.memo = WeightMemo(memo_bytes)
        self.said: Set[str] = set()
        self._asked: Set[Tuple[str, int, int]] = set()
        self._store: Optional[WeightStore] = None
        self._store_opened = False

    def weight(self, target: Tensor, view: Optional[str], channels_last: bool) -> Tensor:
        """Return one image's weight map, [1, H, W] (channels-last: [H, W, 1]); E^ where weights follow the error."""
        made = _counts.stored + _counts.computed
        weight = self.memo.recall(target, lambda: self._make(target, view, channels_last))
        _counts.remembered += _counts.stored + _counts.computed == made
        return weight

    def say_once(self, kind: str, message: str) -> None:
        """Print a line on stderr, the first time that this kind of thing happens; of "active" only rank 0 does."""
        if kind not in self.said:
            self.said.add(kind)
            if kind == "active" and not is_first_process():
                return
            print(f"legs-loss: {message}", file=sys.stderr, flush=True)

    def _make(self, target: Tensor, view: Optional[str], channels_last: bool) -> Tensor:
        weight = self._from_store(target, view, channels_last)
        if weight is not None:
            _counts.stored += 1
            return weight
        _counts.computed += 1
        spec = self.config.spec
        if spec.error > 0.0:
            return normalise_response(response(target, spec.operator, spec.p, channels_last), spec.eps)
        return weight_map(target, spec, channels_last)

    def _from_store(self, target: Tensor, view: Optional[str], channels_last: bool) -> Optional[Tensor]:
        store = self._open_store()
        if store is None or view is None:
            return None
        height, width = target.shape[:2] if channels_last else target.shape[1:]
        if target.device.type != "cpu":
            # Comparing fingerprints waits for the device. Once a view is fair; a target that is a new tensor at every
            # step would wait at every step.
            if (view, height, width) in self._asked:
                return None
            self._asked.add((view, height, width))
        from legs_loss.store import fingerprint

        try:
            entry = store.find(view, height, width, self.config.spec)
            if entry is None:
                self.say_once("absent", f"the store has no map of view {view!r} at {width}x{height}: computed instead")
                return None
            image = target.movedim(-1, 0) if channels_last else target
            if entry.fingerprint != fingerprint(image):
                self.say_once(
                    "changed",
                    f"view {view!r}: the training image is not the one that the stored map was made from, "
                    "so its weight is computed (said once; see docs/precompute.md)",
                )
                return None
            normalised = torch.from_numpy(store.normalised_response(entry)).to(target.device).unsqueeze(0)
        except LegsError as error:
            self.say_once("damaged", f"{error}; the weights of such views are computed")
            return None
        weight = normalised.float()
        if self.config.spec.error == 0.0:
            weight = weight_from_response(normalised, self.config.spec)
        return weight.movedim(0, -1) if channels_last else weight

    def _open_store(self) -> Optional[WeightStore]:
        if not self._store_opened:
            self._store_opened = True
            if self.config.store is not None:
                from legs_loss.store import WeightStore

                try:
                    self._store = WeightStore(self.config.store)
                except LegsError as error:
                    self.say_once("damaged", f"{error}; weights are computed instead")
        return self._store


class _Thread(threading.local):
    """How many calls of `unweighted` functions a thread is in."""

    def __init__(self) -> None:
        self.unweighted = 0  # on the instance: torch.compile does not ask again what the class says


_counts = Counts()
_thread = _Thread()
_run: Optional[_Run] = None
_lock = threading.RLock()


def l1_loss(
    prediction: Tensor,
    target: Tensor,
    view: View = None,
    mask: Optional[Tensor] = None,
    channels_last: bool = False,
    reduction: str = "mean",
    own: Optional[Own] = None,
) -> Tensor:
    """Return the LEGS-weighted L1 loss; a drop-in for the ``l1_loss`` of a 3DGS codebase.

    Args:
        prediction: the rendering, [C, H, W], [B, C, H, W], or with more axes in front, as the views of several
            scenes [B, V, C, H, W]; channels-last on request. Where it requires no gradient (evaluation,
            ``no_grad``) the result is ``torch.abs(prediction - target).mean()``, unweighted.
        target: the photograph as this step supervises it, the same shape; of [C, H, W] beside [1, C, H, W] both are
            taken for a batch of one, as ``torch.abs(prediction - target)`` takes them.
        view: the name of the view, or its number (for a batch: one a view), if the target is that view's own stored
            image. It lets maps from ``legs precompute`` be used; they are used only where the target's fingerprint says
            that they were made from it. Without a name, weights are remembered or computed.
        mask: one value a pixel, zeroes the weight where it is 0.
        channels_last: where the channel stands.
        reduction: "mean", or "none" for the map of weighted errors, in the prediction's shape.
        own: the codebase's own L1 of (prediction, target), where that is more than a mean: what it makes of the
            difference (a mask, another mean) it makes of the weighted difference: it is given the target, and a
            prediction moved away from it by the weight. Unweighted it is called as it is.

    Returns:
        A scalar, or what ``reduction`` or ``own`` say. With beta 0 or LEGS_OFF it is
        ``torch.abs(prediction - target).mean()``, or ``own(prediction, target)``, to the last bit.

    Raises:
        LegsError: shapes that do not fit (both are named), images that lie the other way around than
            ``channels_last`` says, on the CPU a target with NaN or infinity,
            a setting in legs.toml or LEGS_* that is out of range.

    Example:
        >>> target = torch.rand(3, 8, 8)
        >>> prediction = torch.rand(3, 8, 8, requires_grad=True)
        >>> l1_loss(prediction, target) > torch.abs(prediction - target).mean()
        tensor(True)
    """
    if reduction not in ("mean", "none"):
        raise LegsError(f'reduction must be "mean" or "none", got {reduction!r}')
    if own is not None and (mask is not None or reduction != "mean"):
        raise LegsError("own= replaces mask= and reduction=: what it returns is returned")
    if _thread.unweighted or not (prediction.requires_grad and torch.is_grad_enabled()):
        return _plain(prediction, target, mask, channels_last, reduction, own)
    run = _current_run()
    if not run.config.active:
        return _plain(prediction, target, mask, channels_last, reduction, own)
    if isinstance(target, Tensor) and target.dim() > 4 and prediction.shape == target.shape:
        return _in_one_batch(prediction, target, view, mask, channels_last, reduction, own)
    if isinstance(target, Tensor) and prediction.dim() != target.dim():
        prediction, target = _batch_of_one(prediction, target)
    check_pair(prediction, target)
    _check_layout(target, channels_last)
    if is_compiling():  # what the compiler traces has no memory: the weight becomes part of the graph
        spec = run.config.spec
        if spec.error > 0.0:
            weight = error_weight_map(prediction, target, spec, channels_last)
        else:
            weight = weight_map(target, spec, channels_last)
        return _weighted(prediction, target, weight, mask, channels_last, reduction, own)
    run.say_once("active", _describe(run.config))
    _counts.weighted += 1
    views = _view_names(view, target)
    with torch.no_grad():
        if target.dim() == 3:
            weight = run.weight(target, views[0], channels_last)
        else:
            weight = torch.stack([run.weight(target[i], name, channels_last) for i, name in enumerate(views)])
        if run.config.spec.error > 0.0:
            weight = error_weight_map(prediction, target, run.config.spec, channels_last, weight)
    return _weighted(prediction, target, weight, mask, channels_last, reduction, own)


def _batch_of_one(prediction: Tensor, target: Tensor) -> Tuple[Tensor, Tensor]:
    """Of a picture beside a batch of one picture, both as a batch; anything else as it is."""
    if target.shape == (1, *prediction.shape):
        return prediction.unsqueeze(0), target
    return prediction, target.unsqueeze(0) if prediction.shape == (1, *target.shape) else target


def _in_one_batch(
    prediction: Tensor,
    target: Tensor,
    view: View,
    mask: Optional[Tensor],
    channels_last: bool,
    reduction: str,
    own: Optional[Own],
) -> Tensor:
    """As `l1_loss` of images with several axes in front of their own three; ``own`` still meets them all."""
    shape = target.shape

    def folded(tensor: Tensor) -> Tensor:
        return tensor.reshape(-1, *tensor.shape[len(shape) - 3 :])

    def theirs(first: Tensor, second: Tensor) -> Tensor:
        assert own is not None
        return own(first.reshape(shape), second.reshape(shape))

    masked = None if mask is None else folded(mask)
    images = folded(prediction), folded(target)
    loss = l1_loss(*images, view, masked, channels_last, reduction, None if own is None else theirs)
    return loss.reshape(shape) if reduction == "none" else loss


def unweighted(function: Callable[..., Result]) -> Callable[..., Result]:
    """Return a function that calls another, in which ``l1_loss`` is meanwhile plain, as with LEGS_OFF.

    For a loss that compares a rendering with its photograph in one call and with another rendering in the next: in that
    one nothing is to be weighted. Only this thread is concerned, and only until the call returns or raises.

    Args:
        function: what is to be called, a module too.

    Example:
        >>> def photometric(image, gt_image):
        ...     return 0.8 * l1_loss(image, gt_image) + 0.2 * (image - gt_image).square().mean()
        >>> image, other = torch.rand(3, 8, 8, requires_grad=True), torch.rand(3, 8, 8)
        >>> unweighted(photometric)(image, other) < photometric(image, other)
        tensor(True)
    """

    def plain(*args: Any, **kwargs: Any) -> Result:
        _thread.unweighted += 1
        try:
            return function(*args, **kwargs)
        finally:
            _thread.unweighted -= 1

    return plain


def configure(
    spec: Optional[Spec] = None,
    store: Union[str, Path, None] = None,
    memo_bytes: int = DEFAULT_LIMIT,
) -> None:
    """Set what ``l1_loss`` uses in this process, in place of legs.toml; LEGS_OFF still turns it off.

    Args:
        spec: a preset's name or a spec; None keeps what legs.toml and the environment say.
        store: a folder that ``legs precompute`` made.
        memo_bytes: how much memory remembered weight maps may take.

    Raises:
        LegsError: an unknown preset, or settings elsewhere that are out of range.

    Example:
        >>> configure("legs-l")
        >>> configure(replace(as_spec("legs"), curve="C5", beta=4.0))
        >>> configure("legs")
    """
    global _run
    config = find_config(_main_file())
    if spec is not None:
        config = replace(
            config,
            spec=as_spec(spec),
            preset=spec if isinstance(spec, str) else "own spec",
            source="configure()",
        )
    if store is not None:
        config = replace(config, store=Path(store))
    with _lock:
        _run = _Run(config, memo_bytes)


def active() -> bool:
    """Return whether ``l1_loss`` weights what is trained: not with beta 0, nor with LEGS_OFF.

    Raises:
        LegsError: a setting in legs.toml or LEGS_* that is out of range.
    """
    return _current_run().config.active


def counts() -> Counts:
    """Return a copy of this process's counts so far."""
    return replace(_counts)


def _current_run() -> _Run:
    global _run
    if _run is None:
        with _lock:
            if _run is None:
                _run = _Run(find_config(_main_file()))
    return _run


def _main_file() -> Optional[Path]:
    path = getattr(sys.modules.get("__main__"), "__file__", None)
    return Path(path) if path else Path.cwd()


def _plain(
    prediction: Tensor,
    target: Tensor,
    mask: Optional[Tensor],
    channels_last: bool,
    reduction: str,
    own: Optional[Own],
) -> Tensor:
    if not is_compiling():
        _counts.plain += 1
    if own is not None:
        return own(prediction, target)
    return _reduced(prediction, target, None, mask, channels_last, reduction)


def _weighted(
    prediction: Tensor,
    target: Tensor,
    weight: Tensor,
    mask: Optional[Tensor],
    channels_last: bool,
    reduction: str,
    own: Optional[Own],
) -> Tensor:
    if own is None:
        return _reduced(prediction, target, weight, mask, channels_last, reduction)
    # |F + W * (U - F) - F| = W * |U - F|: any L1 of the difference becomes the weighted one, and masks that the
    # codebase makes from the target stay as they are.
    weight = as_map(weight, prediction, channels_last, "weight").to(prediction.dtype)
    return own(target + weight * (prediction - target), target)


def _reduced(
    prediction: Tensor,
    target: Tensor,
    weight: Optional[Tensor],
    mask: Optional[Tensor],
    channels_last: bool,
    reduction: str,
) -> Tensor:
    if reduction == "mean":
        if weight is None and mask is None:
            return torch.abs(prediction - target).mean()
        return weighted_l1(prediction, target, weight, mask, channels_last=channels_last)
    error = torch.abs(prediction - target)
    for factor, name in ((weight, "weight"), (mask, "mask")):
        if factor is not None:
            error = as_map(factor, prediction, channels_last, name).to(error.dtype) * error
    return error


def _check_layout(target: Tensor, channels_last: bool) -> None:
    first, last = (target.shape[-3], target.shape[-1])
    if channels_last:
        first, last = last, first
    if first > 4 and last in (1, 3, 4):
        raise LegsError(
            f"target {list(target.shape)} has its channels {'first' if channels_last else 'last'}: "
            f"call l1_loss with channels_last={not channels_last}"
        )


def _view_names(view: View, target: Tensor) -> Sequence[Optional[str]]:
    batch = target.shape[0] if target.dim() == 4 else 1
    if view is None:
        return [None] * batch
    names: List[Any] = list(view) if isinstance(view, (list, tuple)) else [view]
    if len(names) != batch or not all(isinstance(name, (str, int)) for name in names):
        raise LegsError(f"view must be one name a view: target {list(target.shape)} holds {batch}, got {view!r}")
    return [str(name) for name in names]


def _describe(config: Config) -> str:
    spec = config.spec
    weights = f"maps from {config.store}" if config.store is not None else "maps computed from the training images"
    return (
        f"L1 weighted, preset {config.preset}: {spec.operator}, {spec.curve}, beta {spec.beta:g}; {weights}; "
        f"settings from {config.source}"
    )
