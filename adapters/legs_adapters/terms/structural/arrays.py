"""Torch's operations on small arrays, as far as an SSIM takes them, by numpy in double precision.

Only rational functions of an image's pixels are evaluated: sums, products, quotients, blurs, means. Two of them that
agree on random images are equal. Operations that test an image's values (``clamp``, ``if image.max() > 1``) or its
size (``if height > 256``), or that cut its gradient (``detach``), are not supported.
"""

from __future__ import annotations

import math
import operator
from typing import Any, Callable, Dict, Tuple

import numpy as np

from legs_adapters.code.interpreter.library import Library, Raised, Unsupported

__all__ = ["Tensor", "Torch", "blurred"]

_MOST = 20_000  # values of an array, and products of a window with an image in one evaluation


class Tensor:
    """An array, and whether an image is in it, whose gradient goes through it."""

    def __init__(self, values: Any, of_image: bool) -> None:
        self.values: np.ndarray = np.asarray(values, dtype=np.float64)
        self.of_image = of_image


class _Size:
    """The length of an image's axis: comparisons with it are not supported."""

    def __init__(self, value: int) -> None:
        self.value = value


class _Token:
    """A device, or a number type: there is one of each."""


_DEVICE, _FLOAT = _Token(), _Token()


class Torch(Library):
    """Evaluate torch's operations, in one evaluation.

    Args:
        cuda: whether images report that they are on a GPU.

    Attributes:
        depends_on_device: whether the function asked for that.
    """

    def __init__(self, cuda: bool) -> None:
        self._cuda = cuda
        self._blurs = 0
        self.depends_on_device: bool = False

    def external(self, name: str) -> Any:
        """Return a function or a constant of torch, math or Python."""
        if name in ("torch.conv2d", "torch.nn.functional.conv2d"):
            return self._conv2d
        method = name.rpartition(".")[2]
        if name == f"torch.{method}" and method in _AS_FUNCTIONS:
            return lambda tensor, *given, **named: self.attribute(tensor, method)(*given, **named)
        if name not in _NAMES:
            raise Unsupported(name)
        return _NAMES[name]

    def attribute(self, value: Any, name: str) -> Any:
        """Return an attribute or a method of a tensor."""
        if not isinstance(value, Tensor):
            raise Unsupported(name)
        if name in ("shape", "T"):
            return _shape(value) if name == "shape" else _METHODS["t"](value)
        self.depends_on_device |= name == "is_cuda"
        if name in ("is_cuda", "device", "dtype", "ndim"):
            return {"is_cuda": self._cuda, "device": _DEVICE, "dtype": _FLOAT, "ndim": value.values.ndim}[name]
        if name not in _METHODS or (value.of_image and name in _OF_CONSTANTS):
            raise Unsupported(name)
        return lambda *given, **named: _METHODS[name](value, *given, **named)

    def operate(self, function: Callable[[Any, Any], Any], left: Any, right: Any) -> Any:
        """Return the result of an operator on tensors, numbers and lengths."""
        if isinstance(left, _Size) or isinstance(right, _Size):
            return _Size(int(function(_length(left), _length(right))))
        if function is operator.pow:
            return _power(left, right)
        if function in (operator.floordiv, operator.mod):
            raise Unsupported("a remainder")
        if function is operator.matmul:
            return _product(left, right)
        one, other = (side.values if isinstance(side, Tensor) else np.float64(_number(side)) for side in (left, right))
        _bounded(np.broadcast(one, other).size)
        return _made(function(one, other), left, right)

    def index(self, value: Any, key: Any) -> Any:
        """Return a part of a tuple or of a constant; of an image only all of it, with more axes."""
        if isinstance(value, tuple):
            return value[_number(key)]
        keys = key if isinstance(key, tuple) else (key,)
        whole = all(each is None or each is Ellipsis or each == slice(None) for each in keys)
        if not isinstance(value, Tensor) or (value.of_image and not whole):
            raise Unsupported("an index")
        return _made(value.values[key], value)

    def _conv2d(
        self,
        input: Tensor,
        weight: Tensor,
        bias: None = None,
        stride: Any = 1,
        padding: Any = 0,
        dilation: Any = 1,
        groups: Any = 1,
    ) -> Tensor:
        channels, (kernels, of_each, rows, columns) = input.values.shape[-3], weight.values.shape
        margin = (rows // 2 if rows == columns and rows % 2 else None) if padding == "same" else _one(padding)
        if bias is not None or weight.of_image or (_one(stride), _one(dilation)) != (1, 1):
            raise Unsupported("conv2d")
        if _length(groups) * of_each != channels or kernels % _length(groups):
            raise Raised("conv2d")
        if (kernels, of_each) != (channels, 1):
            raise Unsupported("conv2d")  # channels are mixed
        self._blurs += rows * columns
        _bounded(self._blurs)
        return _made(blurred(input.values, weight.values[:, 0], _number(margin)), input)


def blurred(images: np.ndarray, window: np.ndarray, margin: int) -> np.ndarray:
    """Return images [..., H, W] under a window [..., k, l], with a margin of zeros around them."""
    rows, columns = window.shape[-2:]
    _bounded(margin)
    padded = np.pad(images, [(0, 0)] * (images.ndim - 2) + [(margin, margin)] * 2, "constant")
    if padded.shape[-2] < rows or padded.shape[-1] < columns:
        raise Raised("an image smaller than its window")
    parts = np.lib.stride_tricks.sliding_window_view(padded, (rows, columns), axis=(-2, -1))
    return np.asarray((parts * window[..., None, None, :, :]).sum(axis=(-2, -1)))


def _made(values: Any, *made_of: Any) -> Tensor:
    return Tensor(values, any(isinstance(part, Tensor) and part.of_image for part in made_of))


def _bounded(count: int) -> None:
    if count > _MOST:
        raise Unsupported("too large")


def _number(value: Any) -> Any:
    if not isinstance(value, (int, float)):
        raise Unsupported("no number")
    return value


def _length(value: Any) -> int:
    return value.value if isinstance(value, _Size) else int(_number(value))


def _one(value: Any) -> Any:
    """``(5, 5)`` is 5 for both axes."""
    return value[0] if isinstance(value, tuple) and len(set(value)) == 1 else value


def _shape(tensor: Tensor) -> Tuple[Any, ...]:
    return tuple(_Size(length) if tensor.of_image else length for length in tensor.values.shape)


def _lengths(given: Tuple[Any, ...], times: int = 1) -> Tuple[int, ...]:
    """Return the lengths that ``view(1, 3, h, w)`` or ``view((1, 3, h, w))`` is given."""
    lengths = tuple(map(_length, given[0] if len(given) == 1 and isinstance(given[0], tuple) else given))
    for length in lengths:
        times *= abs(length)
        _bounded(times)
    return lengths


def _range(*given: Any) -> range:
    numbers = range(*map(_number, given))
    _bounded(len(numbers))
    return numbers


def _constant(data: Any, dtype: Any = _FLOAT, device: Any = None, requires_grad: bool = False) -> Tensor:
    if dtype is not _FLOAT or requires_grad:
        raise Unsupported("a type")
    return Tensor([_number(value) for value in data], False)


def _variable(tensor: Tensor) -> Tensor:
    if tensor.of_image:  # of a tensor that is trained it has no gradient
        raise Unsupported("Variable")
    return tensor


def _same(tensor: Tensor, *given: Any, **named: Any) -> Tensor:
    """Return a tensor that is moved: to where it is, in the type that it has."""
    for each in (*given, *named.values()):
        device = isinstance(each, str) and each.startswith(("cuda", "cpu"))
        if not device and not isinstance(each, (Tensor, _Token, bool, int)):
            raise Unsupported("a type")
    return tensor


def _reshaped(tensor: Tensor, *given: Any) -> Tensor:
    lengths = _lengths(given)
    try:
        return _made(tensor.values.reshape(lengths), tensor)
    except ValueError:
        raise Raised("view") from None


def _expanded(tensor: Tensor, *given: Any) -> Tensor:
    lengths = _lengths(given)
    shape = (1,) * (len(lengths) - tensor.values.ndim) + tensor.values.shape
    return _made(
        np.broadcast_to(tensor.values, [was if new == -1 else new for was, new in zip(shape, lengths)]), tensor
    )


def _repeated(tensor: Tensor, *given: Any) -> Tensor:
    return _made(np.tile(tensor.values, _lengths(given, tensor.values.size)), tensor)


def _transposed(tensor: Tensor) -> Tensor:
    if tensor.values.ndim != 2:
        raise Unsupported("t")
    return _made(tensor.values.T, tensor)


def _product(left: Tensor, right: Tensor) -> Tensor:
    if left.of_image or right.of_image or (left.values.ndim, right.values.ndim) != (2, 2):
        raise Unsupported("a matrix product")
    _bounded(left.values.shape[0] * right.values.shape[1])
    return _made(left.values @ right.values)


def _outer(left: Tensor, right: Tensor) -> Tensor:
    _bounded(left.values.size * right.values.size)
    if left.values.ndim != 1 or right.values.ndim != 1:
        raise Raised("outer")
    return _made(np.outer(left.values, right.values), left, right)


def _power(tensor: Tensor, exponent: Any) -> Tensor:
    if not isinstance(exponent, (int, float)) or exponent != 2:
        raise Unsupported("a power")
    return _made(tensor.values * tensor.values, tensor)


def _reduced(reduce: Callable[..., Any]) -> Callable[..., Tensor]:
    def method(tensor: Tensor, dim: Any = None, keepdim: bool = False) -> Tensor:
        axes = () if dim is None else dim if isinstance(dim, tuple) else (dim,)
        if any(not -tensor.values.ndim <= axis < tensor.values.ndim for axis in axes):
            raise Raised("no such axis")
        return _made(reduce(tensor.values, axis=dim, keepdims=keepdim), tensor)

    return method


_NAMES: Dict[str, Any] = {
    **{f"torch.{name}": _constant for name in ("tensor", "Tensor", "FloatTensor")},
    **{f"torch.{name}": _FLOAT for name in ("float", "float32")},
    "torch.arange": lambda *given, **named: _constant(_range(*given), **named),
    "torch.autograd.Variable": _variable,
    "torch.outer": _outer,
    "torch.ger": _outer,
    "math.exp": math.exp,
    "math.sqrt": math.sqrt,
    "math.pi": math.pi,
    "numpy.exp": lambda value: math.exp(_number(value)),
    "len": len,
    "float": lambda value: float(_number(value)),
    "int": lambda value: int(_number(value)),
    "range": _range,
}
_AS_FUNCTIONS = {"exp", "matmul", "mean", "mm", "mul", "pow", "square", "sum"}
_METHODS: Dict[str, Callable[..., Any]] = {
    **{name: _same for name in ("cuda", "to", "type", "type_as", "float", "contiguous", "clone", "detach")},
    "size": lambda tensor, dim=None: _shape(tensor) if dim is None else _shape(tensor)[dim],
    "dim": lambda tensor: tensor.values.ndim,
    "get_device": lambda tensor: _DEVICE,
    "unsqueeze": lambda tensor, dim: _made(np.expand_dims(tensor.values, dim), tensor),
    "t": _transposed,
    "permute": lambda tensor, *axes: _made(np.transpose(tensor.values, _lengths(axes)), tensor),
    "transpose": lambda tensor, one, other: _made(np.swapaxes(tensor.values, one, other), tensor),
    "mm": _product,
    "matmul": _product,
    "view": _reshaped,
    "reshape": _reshaped,
    "expand": _expanded,
    "repeat": _repeated,
    "mean": _reduced(np.mean),
    "sum": _reduced(np.sum),
    "pow": _power,
    "square": lambda tensor: _power(tensor, 2),
    "mul": lambda tensor, other: _made(tensor.values * other.values, tensor, other),
    "exp": lambda tensor: _made(np.exp(tensor.values), tensor),
}
_OF_CONSTANTS = {"exp", "detach"}  # of an image the one is not rational, and the other cuts the gradient
