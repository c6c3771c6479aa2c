"""Watch torch's differences in this process: what is subtracted, under which loss, and what is stepped after it.

A difference that wants a gradient leaves a record in the metadata of its graph node, so that it lives as long as the
graph does: numbers, frames and a thumbnail. Nothing of a backward pass is kept after it but numbers.
"""

from __future__ import annotations

import functools
import os
import sys
from typing import Any, Callable, Dict, List, NamedTuple, Optional, Sequence, Tuple

import torch

from legs_adapters.trace.graph import KEY, Graph
from legs_adapters.trace.photographs import SURE, Photographs, thumbnail

__all__ = ["Watch"]

_SAMPLE = 4096  # values of a leaf that are compared over a step
_POSE = 16  # numbers of a pose, an exposure
_OWN = ("legs_adapters.", "legs_loss.")
_OWNERS = (  # where torch has each difference; the operand from which is subtracted comes first but in __rsub__
    (torch.Tensor, ("__sub__", "__rsub__", "__isub__", "sub", "sub_", "subtract", "subtract_"), "difference"),
    (torch, ("sub", "subtract", "rsub"), "difference"),
    (torch.nn.functional, ("l1_loss",), "l1"),
    (torch.nn.functional, ("mse_loss",), "squared"),
    (torch.nn.functional, ("smooth_l1_loss", "huber_loss"), "robust"),
)

Frame = Tuple[str, int, str, Tuple[str, ...]]


def _harmless(own: Any) -> Any:
    """Wrap a method so that nothing of it is watched, and none of its errors reach the script: the first is kept."""

    @functools.wraps(own)
    def guarded(self: Any, *args: Any) -> Any:
        self._inside = True
        try:
            return own(self, *args)
        except Exception as error:
            self.failure = self.failure or f"{type(error).__name__}: {error}"
            return None
        finally:
            self._inside = False

    return guarded


class _Record(NamedTuple):
    """A difference: its kind, frames, which operand is the target, and that one's thumbnail and shape."""

    kind: str
    frames: Tuple[Frame, ...]
    target: int
    picture: Optional[Any]
    shape: Tuple[int, ...]
    values: Any
    shares: List[Any]


class _Pending(NamedTuple):
    """A term of a backward pass whose step is awaited, and the values of the leaves under it."""

    term: Dict[str, Any]
    leaves: Dict[int, Tuple[Any, Any, Any]]


class Watch:
    """The terms that were seen so far.

    Args:
        root: the checkout, whose frames are kept.
        photographs: the image files that targets are compared with.
        steps: after how many steps `ended` is called.
        ended: ends the script.
    """

    def __init__(self, root: str, photographs: Photographs, steps: int, ended: Callable[[], None]) -> None:
        self.root: str = os.path.join(os.path.realpath(root), "")
        self.photographs: Photographs = photographs
        self.limit = steps
        self.ended = ended
        self.steps: int = 0
        self.backward_passes: int = 0
        self.terms: Dict[Any, Dict[str, Any]] = {}
        self._pending: List[_Pending] = []
        self._files: Dict[str, Optional[str]] = {}
        self._inside = False
        self._names: Dict[int, str] = {}
        self.failure = ""

    def install(self) -> None:
        """Wrap torch's differences, its backward passes and its optimisers, for good."""
        for owner, names, kind in _OWNERS:
            for name in names:
                if hasattr(owner, name):
                    own = getattr(owner, name)
                    setattr(owner, name, self._difference(own, kind, name in ("__rsub__", "rsub")))
        for name in ("backward", "grad"):
            setattr(torch.autograd, name, self._backward(getattr(torch.autograd, name)))
        self._compiled()
        optimiser: Any = torch.optim.Optimizer
        own_init, wrapped = optimiser.__init__, self._step

        def __init__(optimiser: Any, *args: Any, **kwargs: Any) -> None:
            step = type(optimiser).step
            if not hasattr(step, "legs_watched"):
                type(optimiser).step = wrapped(step)
            own_init(optimiser, *args, **kwargs)

        optimiser.__init__ = functools.wraps(own_init)(__init__)

    # -- differences

    def _difference(self, own: Any, kind: str, is_reversed: bool) -> Any:
        @functools.wraps(own, updated=())
        def watched(*args: Any, **kwargs: Any) -> Any:
            made = own(*args, **kwargs)
            if not self._inside and getattr(made, "requires_grad", False) and made.grad_fn is not None:
                sides = [*args, *(kwargs[name] for name in ("input", "other", "target") if name in kwargs)][:2]
                if len(sides) == 2 and all(isinstance(side, torch.Tensor) for side in sides):
                    self._record(kind, sides[::-1] if is_reversed else sides, made)
            return made

        return watched

    def _compiled(self) -> None:
        """Watch autograd functions of other modules, a compiled loss say, that are given both pictures."""
        function: Any = torch.autograd.Function
        own = function.__dict__.get("apply")

        def apply(cls: Any, *args: Any, **kwargs: Any) -> Any:
            call = own.__get__(None, cls) if own is not None else super(function, cls).apply  # type: ignore[misc]
            made = call(*args, **kwargs)
            if not self._inside and getattr(made, "grad_fn", None) is not None:
                pictures = [arg for arg in args if isinstance(arg, torch.Tensor) and arg.dim() > 2]
                pairs = [(a, b) for a, b in zip(pictures, pictures[1:]) if a.shape == b.shape]
                for pair in pairs[:1]:
                    self._record(f"compiled: {cls.__name__}", pair, made)
            return made

        function.apply = classmethod(apply)

    @_harmless
    def _record(self, kind: str, sides: Sequence[Any], made: Any) -> None:
        moving = [side.requires_grad for side in sides]
        largest = max(sides, key=lambda side: side.numel())
        if largest.dim() < 2 or largest.numel() < 64 or not any(moving):
            return
        target = -1 if all(moving) else moving.index(False)
        frames = self._frames(sides)
        if not frames:
            return
        still = sides[target] if target >= 0 else sides[1]
        picture = thumbnail(still) if target >= 0 else None
        node = made.grad_fn
        record = _Record(kind, frames, target, picture, tuple(still.shape), made.detach(), [])
        if KEY not in node.metadata:  # of nested functions the inner one
            node.metadata[KEY] = record
            node.register_hook(functools.partial(_share, record.shares, record.values))

    def _frames(self, sides: Sequence[Any]) -> Tuple[Frame, ...]:
        """Return the frames of the checkout, innermost first, each with its names of the two sides."""
        found: List[Frame] = []
        frame = sys._getframe(4)
        while frame is not None:
            path = self._inside_root(frame.f_code.co_filename)
            if path is None and not found and frame.f_globals.get("__name__", "").startswith(_OWN):
                return ()  # a shim's, or one of the loss that is there already
            if path is not None:
                found.append((path, frame.f_lineno, frame.f_code.co_name, _names(frame, sides)))
            frame = frame.f_back  # type: ignore[assignment]
        return tuple(found)

    def _inside_root(self, name: str) -> Optional[str]:
        if name not in self._files:
            path = os.path.realpath(name)
            inside = path.startswith(self.root) and "site-packages" not in path and not name.startswith("<")
            self._files[name] = path[len(self.root) :].replace(os.sep, "/") if inside else None
        return self._files[name]

    # -- backward passes

    def _backward(self, own: Any) -> Any:
        @functools.wraps(own)
        def watched(tensors: Any, *args: Any, **kwargs: Any) -> Any:
            if self._inside:
                return own(tensors, *args, **kwargs)
            self._settle(False)  # what was stepped without an optimiser of torch's
            roots = list(tensors) if isinstance(tensors, (tuple, list)) else [tensors]
            seen = self._seen(roots) or []
            made = own(tensors, *args, **kwargs)
            self._sum_up(roots, seen)
            return made

        return watched

    @_harmless
    def _seen(self, roots: Sequence[Any]) -> List[Tuple[_Record, str, Dict[int, Any]]]:
        """Return the records under the roots, with what is made of each and the leaves that it leads to."""
        graph = Graph.under([getattr(root, "grad_fn", None) for root in roots])
        found = []
        for at, record in graph.records().items():
            record.shares.clear()
            kind = graph.made_of(at) if record.kind == "difference" else record.kind
            if record.kind == "l1" and graph.made_of(at) not in ("signed", "l1"):
                kind = "robust"
            found.append((record, kind, graph.leaves(at)))
        return found

    @_harmless
    def _sum_up(self, roots: Sequence[Any], seen: Sequence[Tuple[_Record, str, Dict[int, Any]]]) -> None:
        self.backward_passes += 1
        loss = sum(float(root.detach().sum()) for root in roots)
        samples: Dict[int, Tuple[Any, Any, Any]] = {}
        for record, kind, leaves in seen:
            if not record.shares:
                continue  # its gradient was not asked for
            term = self._term(record, kind)
            share = sum(float(part) for part in record.shares) / (loss or 1.0)
            term["shares"].append(share / 2 if kind == "squared" else share)
            for at, leaf in leaves.items():
                if at not in samples:
                    samples[at] = _sample(leaf)
            self._pending.append(_Pending(term, {at: samples[at] for at in leaves}))

    def _term(self, record: _Record, kind: str) -> Dict[str, Any]:
        """Return the entry of a term; those with the same frames, kind and target are one."""
        match = self.photographs.match(record.picture) if record.picture is not None else None
        is_known = match is not None and match.correlation >= SURE
        key = (record.frames, kind, record.target, is_known, is_known and match.is_photograph)  # type: ignore
        fresh = {
            "frames": [list(frame) for frame in record.frames], "kind": kind, "target": record.target,
            "shape": list(record.shape), "is_picture": record.picture is not None, "match": match and match._asdict(),
            "shares": [], "steps": 0, "gaussians": 0, "parameters": [], "stepped": [], "poses": 0,
        }  # fmt: skip
        return self.terms.setdefault(key, fresh)

    # -- steps

    def _step(self, own: Any) -> Any:
        @functools.wraps(own)
        def step(optimiser: Any, *args: Any, **kwargs: Any) -> Any:
            made = own(optimiser, *args, **kwargs)
            if not self._inside:
                for group in optimiser.param_groups:
                    self._names.update((id(leaf), str(group.get("name", ""))) for leaf in group["params"])
                self._settle(True)
            return made

        step.legs_watched = True  # type: ignore[attr-defined]
        return step

    def _settle(self, is_step: bool) -> None:
        """See which leaves changed since their backward pass; end the script after enough steps.

        Without a step of an optimiser, as of a fused one, what has not changed waits on: gradients are accumulated.
        """
        self._inside = True
        try:
            changed: Dict[int, bool] = {}
            waiting, is_counted = [], False
            for term, leaves in self._pending:
                for at, sample in leaves.items():
                    if at not in changed:
                        changed[at] = _has_changed(sample)
                stepped = [leaves[at][0] for at in leaves if changed[at]]
                if stepped:
                    is_counted = self._stepped(term, stepped) or is_counted
                left = {at: sample for at, sample in leaves.items() if not changed[at]}
                if left and not (stepped or is_step):
                    waiting.append(_Pending(term, left))
                elif left and is_step and not stepped:
                    waiting.append(_Pending(term, left))  # of another optimiser, that steps next
            self._pending = waiting[-64:]
            self.steps += is_counted
        finally:
            self._inside = False
        if is_counted and self.steps >= self.limit:
            self.ended()

    def _stepped(self, term: Dict[str, Any], leaves: Sequence[Any]) -> bool:
        """Record what was stepped after a term; return whether it is more than poses, exposures and embeddings."""
        firsts = [leaf.shape[0] for leaf in leaves if leaf.dim() > 1]
        common = max(set(firsts), key=firsts.count) if firsts else 0
        is_model = [leaf for leaf in leaves if not self._is_of_views(leaf, firsts)]
        term["steps"] += bool(is_model)
        term["poses"] += not is_model
        if firsts.count(common) > 2:
            term["gaussians"] = common
        known = {self._names.get(id(leaf)) or "" for leaf in leaves}
        term["parameters"] = sorted({*term["parameters"], *(name for name in known if name)})
        term["stepped"] = sorted({*map(tuple, term["stepped"]), *(tuple(leaf.shape) for leaf in leaves)})[:32]
        return bool(is_model)

    def _is_of_views(self, leaf: Any, firsts: Sequence[int]) -> bool:
        """Return whether a leaf is a pose or an exposure, or a table of such, or of embeddings, a row a view."""
        if leaf.numel() <= _POSE:
            return True
        rows = leaf.shape[0] if leaf.dim() > 1 else 0
        return 0 < rows <= len(self.photographs) and firsts.count(rows) < 3


def _share(shares: List[Any], values: Any, _: Any, gradients: Sequence[Any]) -> None:
    """Add what a difference contributes to the loss: an L1 is the sum of its gradient times its values."""
    if gradients and gradients[0] is not None and gradients[0].shape == values.shape:
        shares.append((gradients[0].detach().float() * values.float()).sum())


def _names(frame: Any, sides: Sequence[Any]) -> Tuple[str, ...]:
    """Return the first two parameters of a frame where they are the two sides, in order; else its names of each."""
    found = ["", ""]
    for name, value in frame.f_locals.items():
        for at, side in enumerate(sides):
            if value is side and not found[at]:
                found[at] = name
    return tuple(found)


def _sample(leaf: Any) -> Tuple[Any, Any, Any]:
    """Return a leaf with values of it that its gradient moves, before the step."""
    with torch.no_grad():
        flat = leaf.detach().reshape(-1)
        gradient = leaf.grad
        if gradient is not None and not gradient.is_sparse and gradient.numel() == flat.numel():
            at = gradient.detach().reshape(-1).abs().topk(min(8, flat.numel())).indices
        else:
            at = torch.arange(0, flat.numel(), max(1, flat.numel() // _SAMPLE), device=flat.device)
        return leaf, at, flat[at].clone()


def _has_changed(sample: Tuple[Any, Any, Any]) -> bool:
    leaf, at, before = sample
    if leaf.numel() <= (int(at.max()) if at.numel() else 0):
        return False
    with torch.no_grad():
        return not torch.equal(leaf.detach().reshape(-1)[at], before)
