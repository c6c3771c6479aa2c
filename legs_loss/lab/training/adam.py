"""Adam over a set of Gaussians that grows and shrinks, with 3DGS's learning rates."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, Dict, Optional

import numpy as np
import torch
from torch import Tensor

from legs_loss.lab.gaussians import Gaussians

SETS = ("gaussians", "moment1", "moment2")
FIELDS = ("means", "log_scales", "quaternions", "opacity_logits", "sh")

# 3DGS's rates. Positions: times the scene's extent, decaying exponentially from the first to the second.
POSITION_RATES = (1.6e-4, 1.6e-6)
RATES = {"log_scales": 5e-3, "quaternions": 1e-3, "opacity_logits": 0.05}
COLOUR_RATE = 2.5e-3  # of the constant harmonic; a twentieth of it for the others


def position_rate(progress: float, extent: float) -> float:
    """Return the learning rate of positions when ``progress``, from 0 to 1, of its way to the last is done.

    >>> position_rate(0.0, 2.0), round(position_rate(0.5, 2.0), 9)
    (0.00032, 3.2e-05)
    """
    first, last = POSITION_RATES
    return extent * first * (last / first) ** progress


def select(gaussians: Gaussians, index: Tensor) -> Gaussians:
    """Return the Gaussians of an index or a mask, detached copies."""
    return Gaussians(*(getattr(gaussians, name).detach()[index] for name in FIELDS))


def stack(first: Gaussians, second: Gaussians) -> Gaussians:
    """Return two sets as one, detached."""
    return Gaussians(*(torch.cat([getattr(first, name).detach(), getattr(second, name).detach()]) for name in FIELDS))


class Adam:
    """The Gaussians as leaf tensors, and their two moments, kept in step as Gaussians come and go."""

    def __init__(self, gaussians: Gaussians) -> None:
        self.steps: int = 0
        self.moment1: Gaussians = Gaussians(*(torch.zeros_like(getattr(gaussians, name)) for name in FIELDS))
        self.moment2: Gaussians = Gaussians(*(torch.zeros_like(getattr(gaussians, name)) for name in FIELDS))
        self._set(gaussians)

    def _set(self, gaussians: Gaussians) -> None:
        self.gaussians: Gaussians = Gaussians(
            *(getattr(gaussians, name).detach().contiguous().requires_grad_(True) for name in FIELDS)
        )

    def step(self, position_rate: float, seen: Optional[Tensor] = None) -> None:
        """Update every parameter from its gradient, or those of the Gaussians ``seen`` [M] alone; drop the gradients.

        What is not seen keeps its moments, too: the sparse Adam of Taming 3DGS and gsplat, but that the moments' biases
        are corrected here, by the number of all steps.
        """
        from legs_loss.kernels.compiling import in_threads
        from legs_loss.lab.training.adam_kernel import BETA1, BETA2, update

        self.steps += 1
        correction1, correction2 = 1 - BETA1**self.steps, np.float32(1 / math.sqrt(1 - BETA2**self.steps))
        for name in FIELDS:
            parameter = getattr(self.gaussians, name)
            columns = parameter[0].numel() if len(parameter) else 1
            rates, scale = _rates(name, columns), position_rate if name == "means" else 1.0
            arrays = parameter.detach(), parameter.grad, getattr(self.moment1, name), getattr(self.moment2, name)
            starts = np.arange(0, parameter.numel(), rates.size) if seen is None else columns * seen.numpy()
            length = rates.size if seen is None else columns
            rates = rates * np.float32(scale / correction1)
            in_threads(update, len(starts), *map(_flat, arrays), starts, length, rates, correction2)
            parameter.grad = None

    def keep(self, kept: Tensor) -> None:
        """Keep the Gaussians of index ``kept`` with their moments, and no others."""
        self.replace(kept, select(self.gaussians, kept[:0]))

    def replace(self, kept: Tensor, new: Gaussians) -> None:
        """Keep the Gaussians of index ``kept`` with their moments, and append ``new`` ones, whose moments are 0."""
        nothing = Gaussians(*(torch.zeros_like(getattr(new, name)) for name in FIELDS))
        self.moment1 = stack(select(self.moment1, kept), nothing)
        self.moment2 = stack(select(self.moment2, kept), nothing)
        self._set(stack(select(self.gaussians, kept), new))

    def reset_opacity(self, ceiling: float) -> None:
        """Lower every opacity to ``ceiling`` at most, and forget its moments."""
        with torch.no_grad():
            self.gaussians.opacity_logits.clamp_(max=math.log(ceiling / (1 - ceiling)))
        self.moment1.opacity_logits.zero_()
        self.moment2.opacity_logits.zero_()

    def state(self) -> Dict[str, Any]:
        """Return arrays from which :meth:`restore` makes an equal optimiser."""
        arrays = {
            f"{label}.{name}": getattr(getattr(self, label), name).detach().numpy() for label in SETS for name in FIELDS
        }
        return dict(arrays, steps=np.array(self.steps))

    @classmethod
    def restore(cls, arrays: Any) -> Adam:
        """Return the optimiser whose :meth:`state` this is."""
        sets = [
            Gaussians(*(torch.from_numpy(np.array(arrays[f"{label}.{name}"])) for name in FIELDS)) for label in SETS
        ]
        adam = cls(sets[0])
        adam.moment1, adam.moment2, adam.steps = sets[1], sets[2], int(arrays["steps"])
        return adam


def _flat(tensor: Tensor) -> np.ndarray:
    return tensor.contiguous().view(-1).numpy()


@lru_cache(maxsize=None)
def _rates(name: str, columns: int) -> np.ndarray:
    """Return every column's learning rate, repeated to a block of whole vectors that is long enough to loop over."""
    rates = np.full(columns, RATES.get(name, 1.0), np.float32)
    if name == "sh":
        rates[:3], rates[3:] = COLOUR_RATE, COLOUR_RATE / 20
    from legs_loss.lab.training.adam_kernel import LANES

    return np.tile(rates, LANES * -(-128 // columns))
