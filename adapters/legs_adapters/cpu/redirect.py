"""Everything that a script asks of CUDA devices, answered by the CPU: functions of torch wrapped once, in place.

A ``TorchFunctionMode`` will not do: it is off inside the backward functions of custom autograd and in other threads,
and never sees ``torch.load``, ``torch.Generator`` or ``torch.cuda.FloatTensor``. Every replacement is an object of its
own, since torch._dynamo holds objects by identity.
"""

from __future__ import annotations

import concurrent.futures
import functools
import importlib
import inspect
import multiprocessing.context
import multiprocessing.pool
import sys
import time
from types import SimpleNamespace, TracebackType
from typing import Any, Callable, Dict, List, Optional, Tuple, Type

import torch
import torch.multiprocessing
import torch.utils.data
from torch import Tensor

from legs_adapters.cpu.loading import LoadsSafely
from legs_adapters.cpu.missing import MissingStandIn
from legs_adapters.cpu.nvidia_smi import memory

__all__ = ["Redirection", "redirect"]

# torch.utils._device knows today's; before torch 2.0 there is no such list.
CONSTRUCTORS = (
    "arange",
    "as_tensor",
    "asarray",
    "bartlett_window",
    "blackman_window",
    "empty",
    "empty_permuted",
    "empty_quantized",
    "empty_strided",
    "eye",
    "full",
    "hamming_window",
    "hann_window",
    "kaiser_window",
    "linspace",
    "logspace",
    "normal",
    "ones",
    "rand",
    "randint",
    "randn",
    "randperm",
    "range",
    "scalar_tensor",
    "sparse_bsc_tensor",
    "sparse_bsr_tensor",
    "sparse_compressed_tensor",
    "sparse_coo_tensor",
    "sparse_csc_tensor",
    "sparse_csr_tensor",
    "tensor",
    "tril_indices",
    "triu_indices",
    "zeros",
)
MEMORY_NUMBERS = (
    "memory_allocated",
    "max_memory_allocated",
    "memory_reserved",
    "max_memory_reserved",
    "memory_cached",
    "max_memory_cached",
    "memory_usage",
    "utilization",
)
NOTHING = (
    "synchronize",
    "empty_cache",
    "set_device",
    "init",
    "ipc_collect",
    "reset_peak_memory_stats",
    "reset_max_memory_allocated",
    "reset_max_memory_cached",
    "reset_accumulated_memory_stats",
    "set_per_process_memory_fraction",
    "set_stream",
    "set_sync_debug_mode",
    "set_rng_state",
    "set_rng_state_all",
    "manual_seed",
    "manual_seed_all",
    "seed",
    "seed_all",
)


class Redirection:
    """What was replaced, so that it can be put back."""

    def __init__(self) -> None:
        self._replaced: List[Tuple[Any, str, Any, bool]] = []

    def replace(self, owner: Any, name: str, new: Any) -> None:
        """Set an attribute that is there, and remember the old one."""
        if not hasattr(owner, name):
            return
        own = name in vars(owner)
        self._replaced.append((owner, name, vars(owner)[name] if own else None, own))
        setattr(owner, name, new)

    def wrap(self, owner: Any, name: str, make: Callable[[Any], Any]) -> None:
        """Replace an attribute by what ``make`` makes of it."""
        if hasattr(owner, name):
            old = getattr(owner, name)
            self.replace(owner, name, functools.update_wrapper(make(old), old, updated=()))

    def restore(self) -> None:
        """Put everything back."""
        while self._replaced:
            owner, name, old, own = self._replaced.pop()
            if own:
                setattr(owner, name, old)
            else:
                delattr(owner, name)

    def __enter__(self) -> Redirection:
        return self

    def __exit__(self, *_: Any) -> None:
        self.restore()


def redirect() -> Redirection:
    """Answer for CUDA from now on, until the result's ``restore()``."""
    redirection = Redirection()
    for part in (_tensors, _modules, _types, _loading, _devices, _runtime, _mixed_precision, _workers):
        part(redirection)
    return redirection


def on_cpu(device: Any) -> Any:
    """Return the CPU for a CUDA device, however it is named, and what is no CUDA device as it is."""
    if isinstance(device, torch.device):
        return torch.device("cpu") if device.type == "cuda" else device
    if isinstance(device, str) and device.partition(":")[0] == "cuda":
        return "cpu"
    if isinstance(device, int) and not isinstance(device, bool):
        return "cpu"
    return device


def _keywords(function: Any) -> Any:
    """A function whose ``device=`` is redirected; nothing needs pinning either."""

    def redirected(*args: Any, **kwargs: Any) -> Any:
        if "device" in kwargs:
            kwargs["device"] = on_cpu(kwargs["device"])
        if kwargs.get("pin_memory"):
            kwargs["pin_memory"] = False
        return function(*args, **kwargs)

    return redirected


def _tensors(redirection: Redirection) -> None:
    signal = getattr(torch, "signal", None)
    owners = [torch, torch.fft, getattr(torch, "nested", None), getattr(signal, "windows", None)]
    known = _known_constructors()
    for owner in filter(None, owners):
        for name, value in list(vars(owner).items()):
            is_constructor = value in known if _hashable(value) else False
            if is_constructor or (owner is torch and (name in CONSTRUCTORS or name.endswith("_like"))):
                redirection.wrap(owner, name, _keywords)
    for name in dir(Tensor):
        if name == "new" or name.startswith("new_"):
            redirection.wrap(Tensor, name, _keywords)
    redirection.wrap(Tensor, "to", _to)
    redirection.wrap(Tensor, "cuda", lambda old: lambda self, *args, **kwargs: self)
    redirection.wrap(Tensor, "cpu", lambda old: lambda self, *args, **kwargs: _own_copy(old(self, *args, **kwargs)))
    redirection.wrap(Tensor, "pin_memory", lambda old: lambda self, *args, **kwargs: self)
    redirection.wrap(Tensor, "is_pinned", lambda old: lambda self, *args, **kwargs: False)
    redirection.wrap(Tensor, "record_stream", lambda old: lambda self, stream: None)
    redirection.wrap(Tensor, "type", _type)


def _known_constructors() -> Any:
    try:
        from torch.utils._device import _device_constructors
    except ImportError:
        return frozenset()
    return _device_constructors()


def _hashable(value: Any) -> bool:
    return callable(value) and getattr(value, "__hash__", None) is not None


def _own_copy(tensor: Tensor) -> Tensor:
    # What leaves the GPU is a copy there: `kept = x.cpu()` does not change with x.
    return tensor.clone()


def _to(old: Any) -> Any:
    def to(self: Tensor, *args: Any, **kwargs: Any) -> Tensor:
        target = kwargs.get("device", args[0] if args else None)
        if "device" in kwargs:
            kwargs["device"] = on_cpu(target)
        elif args and not isinstance(target, (torch.dtype, Tensor)):
            args = (on_cpu(target), *args[1:])
        result: Tensor = old(self, *args, **kwargs)
        # By name: `x.to(y.device)` stays where it is if y is on the GPU too, and says the same here.
        return _own_copy(result) if isinstance(target, str) and target == "cpu" and result is self else result

    return to


def _type(old: Any) -> Any:
    def type_of(self: Tensor, dtype: Any = None, *args: Any, **kwargs: Any) -> Any:
        return old(self, dtype, *args, **kwargs) if dtype is None else old(self, _cpu_type(dtype), *args, **kwargs)

    return type_of


def _cpu_type(kind: Any) -> Any:
    if isinstance(kind, str):
        return kind.replace("torch.cuda.", "torch.")
    return getattr(kind, "on_cpu", kind)


def _modules(redirection: Redirection) -> None:
    module = torch.nn.Module
    redirection.wrap(module, "cuda", lambda old: lambda self, device=None: self)
    redirection.wrap(module, "to", _module_to)
    redirection.wrap(module, "cpu", lambda old: lambda self: self)
    # Scripts that were written to be compiled run as they are: the compiler would see the wrappers.
    redirection.wrap(torch.jit, "script", lambda old: _identity)
    redirection.wrap(torch.jit, "script_method", lambda old: lambda function, _rcb=None: function)


def _identity(obj: Any, *args: Any, **kwargs: Any) -> Any:
    return obj


def _module_to(old: Any) -> Any:
    def to(self: Any, *args: Any, **kwargs: Any) -> Any:
        args = tuple(on_cpu(value) if i == 0 else value for i, value in enumerate(args))
        if "device" in kwargs:
            kwargs["device"] = on_cpu(kwargs["device"])
        return old(self, *args, **kwargs)

    return to


class _Legacy(type):
    """The type of ``torch.cuda.FloatTensor`` and its like: they make, and recognise, tensors of the CPU."""

    on_cpu: Any

    def __instancecheck__(cls, value: Any) -> bool:
        return isinstance(value, cls.on_cpu)

    def __call__(cls, *args: Any, **kwargs: Any) -> Any:
        kwargs.pop("device", None)
        return cls.on_cpu(*args, **kwargs)


def _types(redirection: Redirection) -> None:
    for name in dir(torch.cuda):
        if name.endswith("Tensor") and hasattr(torch, name):
            kind = _Legacy(name, (), {"on_cpu": getattr(torch, name), "__module__": "torch.cuda"})
            redirection.replace(torch.cuda, name, kind)
    redirection.wrap(torch, "set_default_tensor_type", lambda old: lambda kind: old(_cpu_type(kind)))


def _loading(redirection: Redirection) -> None:
    both = LoadsSafely(torch.save, torch.load)
    redirection.wrap(torch, "save", lambda old: lambda *args, **kwargs: both.save(*args, **kwargs))
    redirection.wrap(torch, "load", lambda old: lambda *args, **kwargs: both.load(*args, **kwargs))


class _GeneratorType(type(torch.Generator)):  # type: ignore[misc]
    def __instancecheck__(cls, value: Any) -> bool:
        return isinstance(value, _Generator)


_Generator = torch.Generator


def _devices(redirection: Redirection) -> None:
    class Generator(_Generator, metaclass=_GeneratorType):
        """A random number generator, on the CPU."""

        def __new__(cls, device: Any = "cpu") -> Any:
            return _Generator.__new__(cls, on_cpu(device))  # type: ignore[call-arg]

        def __init__(self, device: Any = "cpu") -> None:
            pass

    redirection.replace(torch, "Generator", Generator)
    redirection.wrap(torch, "set_default_device", lambda old: lambda device: old(on_cpu(device)))
    try:
        from torch.utils._device import DeviceContext
    except ImportError:
        return
    redirection.wrap(DeviceContext, "__init__", lambda old: lambda self, device: old(self, on_cpu(device)))


class Event:
    """``torch.cuda.Event`` by the wall clock."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self._at = 0.0

    def record(self, stream: Any = None) -> None:
        """Take the time."""
        self._at = time.perf_counter()

    def elapsed_time(self, end_event: Event) -> float:
        """Milliseconds from this event to the other."""
        return 1000 * (end_event._at - self._at)

    def synchronize(self) -> None:
        """Nothing runs behind."""

    def wait(self, stream: Any = None) -> None:
        """Nothing runs behind."""

    def query(self) -> bool:
        """Everything is done."""
        return True


class Stream:
    """``torch.cuda.Stream``: there is one, and it is always done."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.device = torch.device("cpu")
        self.cuda_stream = self.stream_id = 0

    def record_event(self, event: Optional[Event] = None) -> Event:
        """Return an event of now."""
        event = event or Event()
        event.record()
        return event

    def synchronize(self) -> None:
        """Nothing runs behind."""

    def wait_event(self, event: Event) -> None:
        """Nothing runs behind."""

    def wait_stream(self, stream: Stream) -> None:
        """Nothing runs behind."""

    def query(self) -> bool:
        """Everything is done."""
        return True


class _Nowhere:
    """A context, such as that of a device, that changes nothing."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        pass

    def __enter__(self) -> _Nowhere:
        return self

    def __exit__(
        self, kind: Optional[Type[BaseException]], error: Optional[BaseException], trace: Optional[TracebackType]
    ) -> None:
        return None


def _constant(value: Any) -> Callable[..., Any]:
    return lambda *args, **kwargs: value


def _runtime(redirection: Redirection) -> None:
    cuda = torch.cuda
    for name in NOTHING:
        redirection.wrap(cuda, name, lambda old: _constant(None))
    for name in MEMORY_NUMBERS:
        redirection.wrap(cuda, name, lambda old: _constant(0))
        redirection.wrap(cuda.memory, name, lambda old: _constant(0))
    total = memory()
    answers = {
        "is_available": True,
        "is_initialized": True,
        "device_count": 1,
        "current_device": 0,
        "is_bf16_supported": False,
        "is_current_stream_capturing": False,
        "initial_seed": 0,
        "get_device_name": "CPU",
        "get_device_capability": (0, 0),
        "get_arch_list": [],
        "mem_get_info": (total, total),
        "memory_summary": "",
        "memory_snapshot": [],
        "get_device_properties": SimpleNamespace(
            name="CPU", total_memory=total, major=0, minor=0, multi_processor_count=1
        ),
    }
    for name, value in answers.items():
        redirection.wrap(cuda, name, functools.partial(lambda value, old: _constant(value), value))
    for name in ("memory_stats", "memory_stats_as_nested_dict"):
        redirection.wrap(cuda, name, lambda old: lambda *args, **kwargs: _Zeros())
    redirection.wrap(cuda, "get_rng_state", lambda old: lambda *args, **kwargs: torch.get_rng_state())
    redirection.wrap(cuda, "get_rng_state_all", lambda old: lambda: [torch.get_rng_state()])
    for name in ("current_stream", "default_stream"):
        redirection.wrap(cuda, name, lambda old: lambda *args, **kwargs: Stream())
    redirection.replace(cuda, "Event", type("Event", (Event,), {}))
    redirection.replace(cuda, "Stream", type("Stream", (Stream,), {}))
    for name in ("device", "device_of", "stream", "StreamContext"):
        redirection.replace(cuda, name, type(name, (_Nowhere,), {}))
    for name in ("range_push", "range_pop", "mark", "range_start", "range_end"):
        redirection.wrap(cuda.nvtx, name, lambda old: _constant(0))
    # torch's own optimisers ask it whether a graph is being captured; in a build for CUDA it believes torch.cuda.
    for name, value in (("is_available", False), ("current_accelerator", None), ("device_count", 0)):
        accelerator = getattr(torch, "accelerator", None)
        redirection.wrap(accelerator, name, functools.partial(lambda value, old: _constant(value), value))
    redirection.replace(cuda, "_lazy_init", _refuse)
    for name in ("CUDAGraph", "graph", "make_graphed_callables"):
        redirection.wrap(cuda, name, _no_graphs)
    try:
        # Only now: in a build for CUDA it would complain that there is no GPU.
        extension = importlib.import_module("torch.utils.cpp_extension")
    except ImportError:  # it needs setuptools
        return
    for name in ("load", "load_inline"):
        redirection.wrap(extension, name, _no_extension)


class _Zeros(Dict[str, int]):
    """Memory statistics: whatever is asked for is 0."""

    def __missing__(self, key: str) -> int:
        return 0


def _refuse() -> None:
    """In place of CUDA's start: whoever needs it is a function that nothing stands in for."""
    caller = sys._getframe(1)
    module = caller.f_globals.get("__name__", "?")
    if module.partition(".")[0] == "torch":
        raise MissingStandIn(module, caller.f_code.co_name)
    raise MissingStandIn("torch.cuda", "", f"{caller.f_code.co_filename}:{caller.f_lineno} makes a tensor on the GPU")


def _no_graphs(old: Any) -> Any:
    def refuse(*args: Any, **kwargs: Any) -> Any:
        raise MissingStandIn("torch.cuda", old.__name__)

    return refuse


def _no_extension(old: Any) -> Any:
    def load(name: str, *args: Any, **kwargs: Any) -> Any:
        raise MissingStandIn("torch.utils.cpp_extension", old.__name__, f"the CUDA extension {name} cannot be built")

    return load


def _mixed_precision(redirection: Redirection) -> None:
    """Autocast and its gradient scaler are off: on the CPU, everything is float32."""
    autocast: Any = torch.autocast
    scaler: Any = getattr(getattr(torch, "amp", None), "GradScaler", None) or torch.cuda.amp.GradScaler

    def autocast_init(self: Any, *args: Any, **kwargs: Any) -> None:
        autocast.__init__(self, "cpu", enabled=False)

    def scaler_init(self: Any, *args: Any, **kwargs: Any) -> None:
        scaler.__init__(self, enabled=False)

    for owner in (torch.cuda.amp, torch, getattr(torch, "amp", None)):
        for name, base, init in (("autocast", autocast, autocast_init), ("GradScaler", scaler, scaler_init)):
            if owner is not None:
                redirection.replace(owner, name, type(name, (base,), {"__init__": init}))


def _workers(redirection: Redirection) -> None:
    """Pools of processes become pools of threads: a process of its own would know nothing of all this."""

    class Executor(concurrent.futures.ThreadPoolExecutor):
        """A pool of threads that takes a process pool's arguments."""

        def __init__(
            self,
            max_workers: Optional[int] = None,
            mp_context: Any = None,
            initializer: Any = None,
            initargs: Tuple[Any, ...] = (),
            **_: Any,
        ) -> None:
            super().__init__(max_workers, initializer=initializer, initargs=initargs)

    def pool(
        processes: Optional[int] = None, initializer: Any = None, initargs: Any = (), *_: Any, **__: Any
    ) -> multiprocessing.pool.ThreadPool:
        return multiprocessing.pool.ThreadPool(processes, initializer, initargs)

    redirection.replace(concurrent.futures, "ProcessPoolExecutor", Executor)
    redirection.replace(concurrent.futures.process, "ProcessPoolExecutor", Executor)
    redirection.wrap(multiprocessing, "Pool", lambda old: pool)
    redirection.wrap(
        multiprocessing.context.BaseContext,
        "Pool",
        lambda old: lambda self, *args, **kwargs: pool(*args, **kwargs),
    )
    redirection.wrap(torch.multiprocessing, "Pool", lambda old: pool)

    def loader(old: Any) -> Any:
        def __init__(self: Any, *args: Any, **kwargs: Any) -> None:
            bound = inspect.signature(old).bind(self, *args, **kwargs)
            bound.arguments["pin_memory"] = False
            if bound.arguments.get("num_workers") and torch.multiprocessing.get_start_method() != "fork":
                bound.arguments["num_workers"] = 0
            old(*bound.args, **bound.kwargs)

        return __init__

    redirection.wrap(torch.utils.data.DataLoader, "__init__", loader)
