"""Watch torch's differences in this process: what is subtracted, under which loss, and what is stepped after it.

A difference that wants a gradient leaves a record in the metadata of its graph node, so that it lives as long as the
graph does. Nothing of a backward pass is kept after it but numbers, and weak references to the leaves.
"""

from __future__ import annotations

import functools
import itertools
import os
import sys
import time
import weakref
from typing import Any, Callable, Dict, List, NamedTuple, Optional, Sequence, Set, Tuple

import torch

import legs_loss
import legs_loss.runtime
from legs_adapters.code.limits import remembered
from legs_adapters.trace.graph import foreign, leaves_under, made_of, nodes_under
from legs_adapters.trace.photographs import SURE, Photographs, as_planes, is_another, thumbnail, uncut
from legs_loss.runtime import counts

_KEY = "legs_loss"  # under which a node's metadata keeps its record
_SAMPLE = 4096  # values of a leaf that are compared over a step
_POSE = 16  # numbers of a pose, an exposure
_OWN = ("legs_adapters.", "legs_loss.")
_OWNERS: Sequence[Tuple[Any, Sequence[str], str]] = (  # where torch has each; all but __rsub__ subtract from the first
    (torch.Tensor, ("__sub__", "__rsub__", "__isub__", "sub", "sub_", "subtract", "subtract_"), "signed"),
    (torch, ("sub", "subtract", "rsub"), "signed"),
    (torch, ("cdist", "dist"), "distance: of any norm"),
    (torch.nn.functional, ("l1_loss",), "l1"),
    (torch.nn.functional, ("mse_loss",), "squared"),
    (torch.nn.functional, ("pairwise_distance",), "distance: of any norm"),
    (torch.nn.functional, ("smooth_l1_loss", "huber_loss"), "robust"),
    (legs_loss, ("l1_loss",), "weighted"),
    (legs_loss.runtime, ("l1_loss",), "weighted"),
)
_SIDES = ("input", "other", "prediction", "target")  # their names, given by name

Frame = Tuple[str, int, Tuple[int, ...], str, Tuple[str, ...]]


def _harmless(own: Any) -> Any:
    """Wrap a method so that nothing of it is watched, and none of its errors reach the script: the first is kept."""

    @functools.wraps(own)
    def guarded(self: Any, *args: Any) -> Any:
        self._inside = True
        try:
            return own(self, *args)
        except Exception as error:
            self.seen["failure"] = self.seen["failure"] or f"{type(error).__name__}: {error}"
            return None
        finally:
            self._inside = False

    return guarded


class _Record(NamedTuple):
    """A difference: its kind, frames, which operand is the target (-1: both are trained), that one, and its values."""

    kind: str
    frames: Tuple[Frame, ...]
    target: int
    still: Any
    values: Any
    shares: List[Any]


class _Sample(NamedTuple):
    """Values of a leaf before its step; of the leaf a weak reference."""

    leaf: Any
    at: Any
    values: Any

    @classmethod
    def of(cls, leaf: Any) -> _Sample:
        """Take the values that the gradient moves most; without a gradient some everywhere."""
        flat, gradient = leaf.detach().reshape(-1), leaf.grad
        if gradient is not None and not gradient.is_sparse and gradient.numel() == flat.numel():
            at = gradient.detach().reshape(-1).abs().topk(min(8, flat.numel())).indices
        else:
            at = torch.arange(0, flat.numel(), max(1, flat.numel() // _SAMPLE), device=flat.device)
        return cls(weakref.ref(leaf), at, flat[at].clone())

    def has_changed(self) -> bool:
        leaf = self.leaf()
        if leaf is None or leaf.numel() <= (int(self.at.max()) if self.at.numel() else 0):
            return False
        return not torch.equal(leaf.detach().reshape(-1)[self.at], self.values)


class Watch:
    """The terms that were seen so far.

    Args:
        root: the checkout, whose frames are kept.
        photographs: the image files that targets are compared with.
        limits: after how many "steps" or "losses" (backward passes of a scalar) the next backward pass ends the script.
        ended: ends the script.
    """

    def __init__(self, root: str, photographs: Photographs, limits: Dict[str, Any], ended: Callable[[], None]) -> None:
        self.root: str = os.path.join(os.path.realpath(root), "")
        self.photographs: Photographs = photographs
        self.limits: Dict[str, Any] = limits
        self.ended: Callable[[], None] = ended
        self.seen: Dict[str, Any] = {"steps": 0, "poses": 0, "backward_passes": 0, "failure": "", "losses": []}
        self.times: List[float] = []
        self.terms: Dict[Any, Dict[str, Any]] = {}
        self.unseen: Set[str] = set()
        self.scripted: Set[Tuple[str, str]] = set()  # files and names of functions of TorchScript: nothing is edited
        self._waiting: Dict[Any, Set[int]] = {}  # terms whose step is awaited, with the ids of the leaves under each
        self._samples: Dict[int, _Sample] = {}
        self._taken: Dict[Any, List[Any]] = {}  # weak references to the gradients that a pass returned for a term
        self.optimisers: Any = weakref.WeakSet()
        self._inside = False

    def report(self) -> Dict[str, Any]:
        """Return what was seen so far, as JSON has it."""
        self._settle()
        found = {"terms": list(self.terms.values()), "unseen": sorted(self.unseen), "scripted": sorted(self.scripted)}
        seconds = [b - a for a, b in zip(self.times, self.times[1:])]
        return {**self.seen, **found, "seconds": seconds, **vars(counts())}

    def install(self) -> None:
        """Wrap torch's differences, its backward passes and its optimisers, for good."""
        for owner, names, kind in _OWNERS:
            for name in names:
                setattr(owner, name, self._difference(getattr(owner, name), kind, name in ("__rsub__", "rsub")))
        for name in ("backward", "grad"):
            setattr(torch.autograd, name, self._backward(getattr(torch.autograd, name), name == "backward"))
        self._functions()
        jit: Any = torch.jit
        own_script = jit.script

        def script(given: Any, *args: Any, **kwargs: Any) -> Any:
            code: Any = getattr(getattr(given, "forward", given), "__code__", None)
            path = self._inside_root(code.co_filename) if code is not None else None
            if path is not None:
                self.scripted.add((path, code.co_name))
            return own_script(given, *args, **kwargs)

        jit.script = functools.wraps(own_script)(script)
        optimiser: Any = torch.optim.Optimizer
        own_init = optimiser.__init__

        def __init__(optimiser: Any, *args: Any, **kwargs: Any) -> None:
            own_init(optimiser, *args, **kwargs)
            self.optimisers.add(optimiser)

        optimiser.__init__ = functools.wraps(own_init)(__init__)

    # -- differences

    def _difference(self, own: Any, kind: str, is_reversed: bool) -> Any:
        @functools.wraps(own, updated=())
        def watched(*args: Any, **kwargs: Any) -> Any:
            if self._inside:
                return own(*args, **kwargs)
            weighted = counts().weighted
            self._inside = kind == "weighted"
            try:
                made = own(*args, **kwargs)
            finally:
                self._inside = False
            sides = [*args, *(kwargs[name] for name in _SIDES if name in kwargs)][:2]
            if getattr(made, "grad_fn", None) is not None and all(isinstance(side, torch.Tensor) for side in sides):
                is_plain = kind == "weighted" and counts().weighted == weighted
                self._record("plain" if is_plain else kind, sides[::-1] if is_reversed else sides, made)
            return made

        return watched

    def _functions(self) -> None:
        """Watch autograd functions of other modules, a fused loss say, that are given both pictures."""
        function: Any = torch.autograd.Function
        own = function.__dict__.get("apply")

        def apply(cls: Any, *args: Any, **kwargs: Any) -> Any:
            call = own.__get__(None, cls) if own is not None else super(function, cls).apply  # type: ignore[misc]
            made = call(*args, **kwargs)
            is_torchs = cls.__module__.startswith("torch.")  # a checkpoint, whose differences are watched
            if not (self._inside or is_torchs) and getattr(made, "grad_fn", None) is not None:
                pictures = [arg for arg in args if isinstance(arg, torch.Tensor) and arg.dim() > 2]
                pair = next(((a, b) for a, b in zip(pictures, pictures[1:]) if a.shape == b.shape), None)
                if pair is not None:
                    self._record(f"compiled: {cls.__name__}", pair, made)
            return made

        function.apply = classmethod(apply)

    @_harmless
    def _record(self, kind: str, sides: Sequence[Any], made: Any) -> None:
        moving = [side.requires_grad for side in sides]
        largest = max(sides, key=lambda side: side.numel())
        node = made.grad_fn
        if len(sides) < 2 or largest.dim() < 2 or largest.numel() < 64 or not any(moving) or _KEY in node.metadata:
            return  # (of nested functions the inner one is kept)
        frames = self._frames(sides)
        if frames:
            target = -1 if all(moving) else moving.index(False)
            still = sides[1].detach() if target < 0 else sides[target]  # (detached it has no base)
            node.metadata[_KEY] = record = _Record(kind, frames, target, still, made.detach(), [])
            node.register_hook(functools.partial(_share, record.shares, record.values, record.values._version))

    def _frames(self, sides: Sequence[Any]) -> Tuple[Frame, ...]:
        """Return the frames of the checkout, innermost first, each with its names of the two sides."""
        found: List[Frame] = []
        frame: Any = sys._getframe(4)
        while frame is not None:
            path, module = self._inside_root(frame.f_code.co_filename), frame.f_globals.get("__name__", "")
            if path is not None:
                found.append((path, frame.f_lineno, _span(frame), frame.f_code.co_name, _names(frame, sides)))
            elif not found and module.startswith(_OWN) and not module.startswith(legs_loss.runtime.__name__):
                return ()  # a shim's, or one of another loss (the run time's `unweighted` calls the script's)
            frame = frame.f_back
        return tuple(found)

    @remembered
    def _inside_root(self, name: str) -> Optional[str]:
        path = os.path.realpath(name)
        inside = path.startswith(self.root) and "site-packages" not in path and not name.startswith("<")
        return path[len(self.root) :].replace(os.sep, "/") if inside else None

    # -- backward passes

    def _backward(self, own: Any, is_step: bool) -> Any:
        @functools.wraps(own)
        def watched(tensors: Any, *args: Any, **kwargs: Any) -> Any:
            if self._inside:
                return own(tensors, *args, **kwargs)
            self._settle()
            made = {"steps": self.seen["steps"] + self.seen["poses"] // 20, "losses": len(self.seen["losses"])}
            if any(made[name] >= most for name, most in self.limits.items()):
                self.ended()
            roots = list(tensors) if isinstance(tensors, (tuple, list)) else [tensors]
            is_loss = is_step and len(roots) == 1 and roots[0].numel() == 1
            if is_loss:
                self.seen["losses"].append(float(roots[0].detach()).hex())
                self.times.append(time.process_time())
            seen = self._seen(roots) or []
            gradients = own(tensors, *args, **kwargs)
            self._sum_up(roots, seen, len(self.seen["losses"]) if is_loss else 0, gradients)
            return gradients

        return watched

    @_harmless
    def _seen(self, roots: Sequence[Any]) -> List[Tuple[_Record, Any, List[Any]]]:
        """Return the records under the roots, the key of the term of each, and the leaves that it leads to."""
        nodes = nodes_under(getattr(root, "grad_fn", None) for root in roots)
        self.unseen |= foreign(nodes)
        found, known = [], []
        for node in (node for node in nodes if _KEY in node.metadata):
            record: _Record = node.metadata[_KEY]
            record.shares.clear()
            kind = made_of(node, nodes, record.kind) if record.kind in ("signed", "l1") else record.kind
            if kind == "l1" or (record.target >= 0 and (kind != "signed" or as_planes(record.still) is not None)):
                key, match, picture = self._term(record, kind)
                found.append((record, key, leaves_under(node)))
                if key[-1] is not None and not self.terms[key]["is_rival"]:
                    known.append((match, picture, self.terms[key]))
        known.sort(key=lambda each: -each[0].detail)
        for at, (match, picture, term) in enumerate(known):  # less like a file than another picture under the same loss
            best = next((b for other, b, _ in known[:at] if other.path == match.path), None)
            term["is_rival"] |= best is not None and is_another(picture, best)  # no part or exposure of that
        return found

    def _term(self, record: _Record, kind: str) -> Any:
        """Return a term's key, its picture's match, that picture; those of the same frames, kind, target are one."""
        picture = thumbnail(record.still) if record.target >= 0 else None
        match = self.photographs.match(picture)
        whole = uncut(record.still) if match is not None and match.correlation < SURE else None
        match = match if whole is None else self.photographs.match(thumbnail(whole))
        known = None if match is None or match.correlation < SURE else match.is_photograph
        key = record.frames, kind, record.target, known
        self.terms.setdefault(key, {
            "frames": record.frames, "kind": kind, "target": record.target, "shape": list(record.still.shape),
            "is_picture": picture is not None, "match": match and match._asdict(), "is_known": known is not None,
            "largest": 0.0 if picture is None else float(record.still.detach().nan_to_num().abs().max()),
            "is_rival": False, "is_read": True,
            "shares": [], "steps": 0, "gaussians": 0, "parameters": [], "stepped": [], "poses": 0,
        })  # fmt: skip
        return key, match, as_planes(record.still) if whole is None else whole

    @_harmless
    def _sum_up(self, roots: Any, seen: Sequence[Tuple[_Record, Any, List[Any]]], at: int, gradients: Any) -> None:
        self.seen["backward_passes"] += 1
        loss = sum(float(root.detach().sum()) for root in roots)
        for record, key, leaves in seen:
            if not record.shares:
                continue  # its gradient was not asked for
            share = sum(float(part) for part in record.shares) / (loss or 1.0)
            self.terms[key]["shares"].append((at, share / 2 if self.terms[key]["kind"] == "squared" else share))
            self.terms[key]["is_read"] &= gradients is not None  # of torch.autograd.grad, until a leaf has one
            self._taken[key] = [weakref.ref(each) for each in gradients or () if each is not None]
            self._waiting.setdefault(key, set()).update(map(id, leaves))
            for leaf in leaves:
                if id(leaf) not in self._samples or self._samples[id(leaf)].leaf() is not leaf:
                    self._samples[id(leaf)] = _Sample.of(leaf)

    # -- steps

    @_harmless
    def _settle(self) -> None:
        """Count a step of the terms of which a leaf changed since their backward pass, one of poses alone apart.

        What has not changed waits on: for another optimiser, or until enough gradients are accumulated.
        """
        changed = {at for at, sample in self._samples.items() if sample.has_changed()}
        stepped: List[bool] = []
        for key, leaves in list(self._waiting.items()):
            if leaves & changed:
                moved = [self._samples[at].leaf() for at in leaves & changed]
                own = [leaf.grad for leaf in moved if leaf.grad is not None]
                self.terms[key]["is_read"] &= not any(taken() is each for taken in self._taken[key] for each in own)
                stepped.append(self._stepped(self.terms[key], moved))
                del self._waiting[key]
        awaited = set().union(*self._waiting.values()) - changed
        self._samples = {at: each for at, each in self._samples.items() if at in awaited and each.leaf() is not None}
        self.seen["steps"] += any(stepped)
        self.seen["poses"] += bool(stepped) and not any(stepped)

    def _stepped(self, term: Dict[str, Any], leaves: Sequence[Any]) -> bool:
        """Record what was stepped after a term; return whether it is more than poses, exposures and embeddings."""
        groups = [group for optimiser in self.optimisers for group in optimiser.param_groups]
        ids = {id(leaf) for leaf in leaves}
        names = {group.get("name", "") for group in groups if ids.intersection(map(id, group["params"]))}
        firsts = [leaf.shape[0] for leaf in leaves if leaf.dim() > 1]
        common = max(firsts, key=firsts.count, default=0)
        is_model = not all(self._is_of_views(leaf, firsts) for leaf in leaves)
        term["steps" if is_model else "poses"] += 1
        term["gaussians"] = common if firsts.count(common) > 2 else term["gaussians"]
        term["parameters"] = sorted({*term["parameters"], *map(str, names)} - {""})
        term["stepped"] = sorted({*map(tuple, term["stepped"]), *(tuple(leaf.shape) for leaf in leaves)})[:32]
        return is_model

    def _is_of_views(self, leaf: Any, firsts: Sequence[int]) -> bool:
        """Return whether a leaf is a pose or an exposure, or a table of such, or of embeddings, a row a view."""
        rows = leaf.shape[0] if leaf.dim() > 1 else 0
        return leaf.numel() <= _POSE or (0 < rows <= len(self.photographs) and firsts.count(rows) < 3)


def _share(shares: List[Any], values: Any, version: int, _: Any, gradients: Sequence[Any]) -> None:
    """Add what a difference contributes to the loss: an L1 is the sum of its gradient times its values."""
    if gradients and gradients[0] is not None and gradients[0].shape == values.shape:
        parts = gradients[0].detach().float() * values.float()
        shares.append((parts if values._version == version else parts.abs()).sum())  # abs_() took the values' signs


def _span(frame: Any) -> Tuple[int, ...]:
    """Return the last line, the first and last column of the expression that a frame is at; not before Python 3.11."""
    positions = frame.f_code.co_positions() if hasattr(frame.f_code, "co_positions") else ()
    line, *span = next(itertools.islice(positions, frame.f_lasti // 2, None), (None,))
    return tuple(span) if line == frame.f_lineno and None not in span else ()


def _names(frame: Any, sides: Sequence[Any]) -> Tuple[str, ...]:
    """Return the first two parameters of a frame where they are the two sides, in order; else its names of each."""
    known = frame.f_locals
    return tuple(next((name for name in known if known[name] is side), "") for side in sides)
