"""Ways of torch to run what is computed now: compiled, transformed, recorded for a gradient."""

from __future__ import annotations

import sys
from typing import Any, Callable

import torch
from torch import Tensor
from torch.autograd import forward_ad

from legs_loss.errors import LegsError


def _never(*_: object) -> bool:
    return False


# Whether torch.compile is tracing: checks that read values from the device are skipped then.
is_compiling: Callable[[], bool] = getattr(getattr(torch, "compiler", None), "is_compiling", _never)

# The backward pass that this runs in, as the second pass of a checkpoint does; -1 in none.
backward_pass: Callable[[], int] = getattr(torch._C, "_current_graph_task_id", lambda: -1)

_functorch: Any = getattr(torch._C, "_functorch", None)  # of torch.func; torch 1.12 has none
is_wrapped: Callable[[Tensor], bool] = getattr(_functorch, "is_functorch_wrapped_tensor", _never)  # by torch.func
_levels: Any = getattr(_functorch, "peek_interpreter_stack", None)
_modes: Any = getattr(torch._C, "_len_torch_dispatch_stack", None)
# Of the dispatch modes, those under which a tensor may have no memory; others, as torch's FlopCounterMode, only watch.
_mode_of: Any = getattr(torch._C, "_get_dispatch_mode", None)
_keys: Any = getattr(torch._C, "_TorchDispatchModeKey", None)
_MEMORYLESS = [getattr(_keys, key, None) for key in ("FAKE", "PROXY", "FUNCTIONAL")]


def is_differentiated() -> bool:
    """Return whether torch.func or forward-mode AD is around, also of a graph that is being compiled."""
    return forward_ad._current_level >= 0 or (_levels is not None and _levels() is not None)


_OF_NODES = ("forward", "apply", "call_function")  # of a Function, of all Functions, of one that torch.compile traces
_SETUP = getattr(torch.autograd.Function, "setup_context", None)


def is_in_a_node() -> bool:
    """Return whether this runs, or is compiled, in the forward pass of an autograd.Function that becomes a node."""
    frame = None if torch.is_grad_enabled() else sys._getframe(1)
    while frame is not None:
        code = frame.f_code
        if code.co_name in _OF_NODES and code.co_argcount:
            first = frame.f_locals.get(code.co_varnames[0])
            # A context has no next functions where the graph does not get this node.
            is_node = isinstance(first, torch.autograd.function.FunctionCtx) and getattr(first, "next_functions", None)
            if is_node or type(first).__name__ == "AutogradFunctionApplyVariable":
                return True
            if getattr(first, "setup_context", _SETUP) is not _SETUP:  # its forward has no context
                return any(isinstance(one, Tensor) and one.requires_grad for one in frame.f_locals["args"])
        frame = frame.f_back
    return False


def is_transformed() -> bool:
    """Return whether torch.func, forward-mode AD or a recording (torch.jit.trace, make_fx) sees what is computed now.

    Then tensors may have no memory to read, and what is computed is valid until the transform ends: torch computes it,
    and nothing is looked up or kept.
    """
    if is_differentiated() or torch._C._get_tracing_state() is not None:
        return True
    return _modes is not None and _modes() > 0 and (None in _MEMORYLESS or any(map(_mode_of, _MEMORYLESS)))


def is_trained(image: Tensor) -> bool:
    """Return whether a derivative in an image is taken, in whatever way: a gradient, torch.func, forward-mode AD.

    The first pass of a re-entrant checkpoint counts, too: it runs without gradients, which its second pass takes.
    """
    if image.requires_grad and torch.is_grad_enabled():
        return True
    if is_compiling():
        return False
    if not is_transformed():
        return is_in_a_node()
    while True:  # each transform wraps the tensor of the one outside it
        batched = _functorch is not None and _functorch.is_batchedtensor(image)
        if image.requires_grad and torch.is_grad_enabled():
            return True
        if forward_ad._current_level >= 0 and not batched and forward_ad.unpack_dual(image).tangent is not None:
            return True
        if _functorch is None or not _functorch.is_functorch_wrapped_tensor(image):
            return False
        image = _functorch.get_unwrapped(image)


def check_order(prediction: Tensor, target: Tensor) -> None:
    """Check that a loss whose weights come from its second image is not given the rendering there.

    Raises:
        LegsError: gradients are taken, and the second image alone requires one.
    """
    if not is_trained(prediction) and is_trained(target):
        raise LegsError(
            "of the two images only the second requires a gradient, so it seems to be the rendering: turn them round, "
            "loss(rendering, photograph). For a photograph that is learned: legs_loss.unweighted(l1_loss), or a weight="
        )
