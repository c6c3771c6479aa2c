"""What torch's operations do to a value: keep it, join it with others, ask only for its size."""

from __future__ import annotations

from typing import List, Set

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.syntax import children

__all__ = ["JOINS", "SIZES", "depends"]

JOINS = {"cat", "stack", "concat", "concatenate", "hstack", "vstack"}
# What is asked of a tensor without a look at its values.
SIZES = {"shape", "device", "dtype", "dim", "ndim", "size", "numel", "is_cuda"}


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
