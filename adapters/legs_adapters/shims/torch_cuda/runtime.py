"""Replace torch.cuda's functions: one idle device with the machine's memory, no graphs, no mixed precision."""

from __future__ import annotations

import functools
import importlib
import sys
from types import SimpleNamespace
from typing import Any, Dict

import torch

from legs_adapters.shims.missing import MissingShim
from legs_adapters.shims.nvidia_smi import memory
from legs_adapters.shims.torch_cuda.redirection import Redirection, constant
from legs_adapters.shims.torch_cuda.streams import Event, Nowhere, Stream

__all__ = ["redirect"]

MEMORY_NUMBERS = """
    memory_allocated max_memory_allocated memory_reserved max_memory_reserved memory_cached max_memory_cached
    memory_usage utilization
"""
NOTHING = """
    synchronize empty_cache set_device init ipc_collect reset_peak_memory_stats reset_max_memory_allocated
    reset_max_memory_cached reset_accumulated_memory_stats set_per_process_memory_fraction set_stream
    set_sync_debug_mode set_rng_state set_rng_state_all manual_seed manual_seed_all seed seed_all
"""


def redirect(redirection: Redirection) -> None:
    """Redirect the functions of torch.cuda, mixed precision and the building of extensions."""
    _mixed_precision(redirection)
    cuda = torch.cuda
    for name in NOTHING.split():
        redirection.wrap(cuda, name, lambda old: constant(None))
    for name in MEMORY_NUMBERS.split():
        redirection.wrap(cuda, name, lambda old: constant(0))
        redirection.wrap(cuda.memory, name, lambda old: constant(0))
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
        redirection.wrap(cuda, name, functools.partial(lambda value, old: constant(value), value))
    for name in ("memory_stats", "memory_stats_as_nested_dict"):
        redirection.wrap(cuda, name, lambda old: lambda *args, **kwargs: _Zeros())
    redirection.wrap(cuda, "get_rng_state", lambda old: lambda *args, **kwargs: torch.get_rng_state())
    redirection.wrap(cuda, "get_rng_state_all", lambda old: lambda: [torch.get_rng_state()])
    for name in ("current_stream", "default_stream"):
        redirection.wrap(cuda, name, lambda old: lambda *args, **kwargs: Stream())
    redirection.replace(cuda, "Event", type("Event", (Event,), {}))
    redirection.replace(cuda, "Stream", type("Stream", (Stream,), {}))
    for name in ("device", "device_of", "stream", "StreamContext"):
        redirection.replace(cuda, name, type(name, (Nowhere,), {}))
    for name in ("range_push", "range_pop", "mark", "range_start", "range_end"):
        redirection.wrap(cuda.nvtx, name, lambda old: constant(0))
    # torch's own optimisers ask it whether a graph is being captured; in a build for CUDA it believes torch.cuda.
    for name, value in (("is_available", False), ("current_accelerator", None), ("device_count", 0)):
        accelerator = getattr(torch, "accelerator", None)
        redirection.wrap(accelerator, name, functools.partial(lambda value, old: constant(value), value))
    redirection.replace(cuda, "_lazy_init", _refuse)
    for name in ("CUDAGraph", "graph", "make_graphed_callables"):
        redirection.wrap(cuda, name, _no_graphs)
    try:
        # Only now: in a build for CUDA it would warn that there is no GPU.
        extension = importlib.import_module("torch.utils.cpp_extension")
    except ImportError:  # it needs setuptools
        return
    for name in ("load", "load_inline"):
        redirection.wrap(extension, name, _no_extension)


class _Zeros(Dict[str, int]):
    """Memory statistics: every value is 0."""

    def __missing__(self, key: str) -> int:
        return 0


def _refuse() -> None:
    """Replace the initialisation of CUDA: only functions without a shim need it."""
    caller = sys._getframe(1)
    module = caller.f_globals.get("__name__", "?")
    if module.partition(".")[0] == "torch":
        raise MissingShim(module, caller.f_code.co_name)
    raise MissingShim("torch.cuda", "", f"{caller.f_code.co_filename}:{caller.f_lineno} makes a tensor on the GPU")


def _no_graphs(old: Any) -> Any:
    def refuse(*args: Any, **kwargs: Any) -> Any:
        raise MissingShim("torch.cuda", old.__name__)

    return refuse


def _no_extension(old: Any) -> Any:
    def load(name: str, *args: Any, **kwargs: Any) -> Any:
        raise MissingShim("torch.utils.cpp_extension", old.__name__, f"the CUDA extension {name} cannot be built")

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
