"""What torch's operations, and Python's around them, do to a value: one table, by what an operation does.

An operation may stand in several rows: ``detach`` moves a value, and ends its gradient.
"""

from __future__ import annotations

from typing import Dict, FrozenSet, List, Set

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.syntax import children

__all__ = [
    "AXES", "ENDS_GRADIENT", "JOINS", "LIMITS", "MAKES", "MOVES", "PICTURE_FUNCTIONS", "PICTURE_METHODS", "SIZES",
    "TRANSFORMS", "depends",
]  # fmt: skip

_TABLE = """
moves         astype clone contiguous copy cpu cuda deepcopy detach double float half numpy requires_grad_ to type
moves         type_as
makes         array as_tensor asarray from_numpy tensor
limits        clamp clamp_ clamp_max clamp_min clip nan_to_num round
axes          T expand expand_as flatten flip movedim permute rearrange repeat reshape reshape_as roll rot90 squeeze
axes          transpose unsqueeze view view_as
picks         chunk index_select narrow select split unbind
gathers       gather masked_select
computes      add cumsum div div_ masked_fill mean mul mul_ pow sub sum
filters       abs conv2d einsum relu sigmoid
resamples     avg_pool2d center_crop crop gaussian_blur grid_sample interpolate max_pool2d pad resize
passes        DataLoader checkpoint enumerate iter list next no_grad reversed tqdm tuple zip
joins         cat concat concatenate hstack stack vstack
sizes         device dim dtype is_cuda ndim numel shape size
ends_gradient detach item numpy tolist
transforms    exp log log10 log1p log2 pow sigmoid sqrt square tanh
"""


def _rows() -> Dict[str, FrozenSet[str]]:
    found: Dict[str, FrozenSet[str]] = {}
    for line in _TABLE.strip().splitlines():
        row, *names = line.split()
        found[row] = found.get(row, frozenset()).union(names)
    return found


_ROWS = _rows()
MOVES = _ROWS["moves"]  # the same values: on another device, in another type or in memory of their own
MAKES = _ROWS["makes"]  # a tensor or an array of the same values
LIMITS = _ROWS["limits"]  # the same values where they are in range
AXES = _ROWS["axes"]  # the same values in another order or shape
JOINS = _ROWS["joins"]  # several values as one
_PASSES_ON = _ROWS["passes"]  # Python's ways to hand a value on
SIZES = _ROWS["sizes"]  # what is asked of a tensor without a look at its values
ENDS_GRADIENT = _ROWS["ends_gradient"]  # no gradient comes back
TRANSFORMS = _ROWS["transforms"]  # an absolute value is none any more
# What leaves a picture a picture: its methods, which keep its values, pick some of them or mix in others...
PICTURE_METHODS = MOVES | LIMITS | AXES | _ROWS["picks"] | _ROWS["computes"]
# ... and functions of it, which also make a tensor of it, filter it or give it another size.
PICTURE_FUNCTIONS = PICTURE_METHODS | MAKES | _PASSES_ON | _ROWS["gathers"] | _ROWS["filters"] | _ROWS["resamples"]


def depends(function: Function, node: cst.CSTNode, names: Set[str]) -> bool:
    """Return whether an expression of a function is made of what one of these names holds, not of its size alone."""
    seen: Set[int] = set()
    work: List[cst.CSTNode] = [node]
    while work:
        part = work.pop()
        if isinstance(part, cst.Name):
            if part.value in names:
                return True
            new = [d for d in function.flow.reaching(part) if id(d) not in seen]
            seen.update(id(definition) for definition in new)
            work.extend(definition.value for definition in new if definition.value is not None)
        elif not (isinstance(part, cst.Attribute) and part.attr.value in ("shape", "device", "dtype")):
            work.extend(children(part))
    return False
