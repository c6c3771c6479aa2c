"""Weight maps in memory, or the two numbers that make one, bounded, each valid only for the target it was made from.

The key is the target, not the name of a view: a codebase may shift, resize or composite a view's target from one step
to the next, and a wrong weight raises no error. So the key of a map is:

- on the CPU, its bytes (a SHA-256 of them): memory that numpy shares can change without torch noticing;
- on a device, where reading the bytes would wait for it, the tensor itself: the same storage, the same view of it,
  still alive, and not written to since (torch counts in-place writes, except through ``.data``). A target that is
  uploaded at each step is a new tensor, so its weight is recomputed. On another CUDA stream it is recomputed, too: a
  stream may not read memory that another one is still writing or has freed.
"""

from __future__ import annotations

import hashlib
import mmap
import threading
import weakref
from collections import OrderedDict
from dataclasses import dataclass
from typing import Any, Callable, Hashable, Optional, Tuple, TypeVar

import torch
from torch import Tensor

DEFAULT_LIMIT = 1 << 30  # bytes
Value = TypeVar("Value")
_LARGE = 1 << 16  # bytes
_OVERHEAD = 1 << 10  # bytes of an entry beside its values: key, tensor, bookkeeping


class WeightMemo:
    """A mapping from targets to weight maps, or to ranges of responses, that takes at most ``limit`` bytes.

    When it is full, a map that was never used again is evicted; if there is none, nothing is stored and the caller
    computes. (Training visits every view once an epoch: evicting the least recently used would evict each map
    just before its next use.)

    Args:
        limit: bytes of memory.

    Examples:
        >>> memo, target = WeightMemo(), torch.rand(3, 4, 4)
        >>> weight = memo.recall(target, lambda: torch.ones(1, 4, 4))
        >>> memo.recall(target.clone(), lambda: torch.zeros(1, 4, 4)) is weight
        True
        >>> memo.recall(target + 0.001, lambda: torch.zeros(1, 4, 4)) is weight
        False
    """

    def __init__(self, limit: int = DEFAULT_LIMIT) -> None:
        self.limit = limit
        self.bytes: int = 0
        self._entries: OrderedDict[Hashable, _Kept] = OrderedDict()
        self._lock = threading.RLock()

    def recall(self, target: Tensor, make: Callable[[], Value], form: Hashable = None) -> Value:
        """Return the value of this target; or make it, and store it if the target can be identified later.

        Args:
            target: the image.
            make: makes its weight map; or what takes little memory, as the range of its response.
            form: the kind of value, if there are several; each is stored separately.
        """
        found, owner = _key(target)
        if found is None:
            return make()
        key = found, form
        with self._lock:
            entry = self._entries.get(key)
            if entry is not None:
                entry.used = True
                kept: Value = entry.value()
                return kept
        value = make()
        size = _size(value)
        with self._lock:
            self._drop(key)
            if self._make_room(size):
                self._entries[key] = _Kept(value, size, self._alive(owner, key))
                self.bytes += size
        return value

    def _alive(self, owner: Optional[Tensor], key: Hashable) -> Optional[weakref.ref[Tensor]]:
        """Return what drops a key that is an address with the owner of that memory: the allocator reuses addresses."""
        if owner is None:
            return None
        memo = weakref.ref(self)

        def forget(_: object) -> None:
            alive = memo()
            if alive is not None:
                with alive._lock:
                    alive._drop(key)

        return weakref.ref(owner, forget)

    def _drop(self, key: Hashable) -> None:
        entry = self._entries.pop(key, None)
        if entry is not None:
            self.bytes -= entry.size

    def _make_room(self, size: int) -> bool:
        unused = [key for key, entry in self._entries.items() if not entry.used]
        while unused and self.bytes + size > self.limit:
            self._drop(unused.pop(0))
        return self.bytes + size <= self.limit


def _size(value: object) -> int:
    """Return the bytes that an entry takes."""
    size = value.numel() * value.element_size() if isinstance(value, Tensor) else 0
    return _OVERHEAD + (-(-size // mmap.PAGESIZE) * mmap.PAGESIZE if size >= _LARGE else size)


@dataclass
class _Kept:
    """A value of the memo; a large map of the CPU is kept as bytes in pages of their own, with its type and shape.

    A tensor that stays on the heap is surrounded by the temporaries of its computation, which fragments the heap: a
    memo of such tensors took twice the memory that it counted.
    """

    kept: Any
    size: int
    owner: Optional[weakref.ref[Tensor]]
    form: Optional[Tuple[torch.dtype, torch.Size]] = None
    used: bool = False

    def __post_init__(self) -> None:
        value = self.kept
        if type(value) is Tensor and value.device.type == "cpu" and value.numel() * value.element_size() >= _LARGE:
            self.kept, self.form = mmap.mmap(-1, value.numel() * value.element_size()), (value.dtype, value.shape)
            torch.frombuffer(self.kept, dtype=value.dtype).copy_(value.reshape(-1))

    def value(self) -> Any:
        return self.kept if self.form is None else torch.frombuffer(self.kept, dtype=self.form[0]).reshape(self.form[1])


# Of a target, if it can be known again; and the tensor with whose end that ends, if it does.
_Key = Tuple[Optional[Hashable], Optional[Tensor]]


def _key(target: Tensor) -> _Key:
    return _content_key(target) if target.device.type == "cpu" else _identity_key(target)


def _content_key(target: Tensor) -> _Key:
    values = target.detach().resolve_neg().contiguous()
    digest = hashlib.sha256(values.reshape(-1).view(torch.uint8).numpy().data).digest()
    return (digest, tuple(target.shape), target.dtype), None


def _identity_key(target: Tensor) -> _Key:
    try:
        version = target._version
    except RuntimeError:  # an inference tensor counts no writes
        return None, None
    # `camera.original_image[:3]` is a new tensor every step; its base tensor is not.
    owner = target if target._base is None else target._base
    stream = _current_stream(target.device)
    return (id(owner), target.data_ptr(), version, target.shape, target.stride(), target.dtype, stream), owner


_raw_stream: Any = getattr(torch._C, "_cuda_getCurrentRawStream", None)  # some microseconds faster


def _current_stream(device: torch.device) -> Optional[int]:
    if device.type != "cuda":
        return None
    return int(_raw_stream(device.index) if _raw_stream else torch.cuda.current_stream(device).cuda_stream)
