"""Error maps with other uses than the loss: ``error = torch.abs(image - gt)`` that also makes a mask."""

from __future__ import annotations

import ast
import functools
from typing import Dict, Iterable, List, Optional, Tuple

from legs_adapters.code.module import Function
from legs_adapters.code.reaching import Definition, Reaching
from legs_adapters.code.syntax import attribute_chain, call_name, given, walk_expressions
from legs_adapters.lexicon.masks import makes_mask
from legs_adapters.tensors.backward import Training
from legs_adapters.tensors.gradients import no_grad_around
from legs_adapters.tensors.operations import EXTREMES, LEAVES, SIZES, TRANSFORMS
from legs_adapters.terms.form import Form

_USING = (ast.Attribute, ast.AugAssign, ast.BinOp, ast.Call, ast.Compare)  # isinstance is slow for others


class _Uses:
    """The uses of a function's expressions, by their ids, found in one walk over it; and the values of its names."""

    def __init__(self, function: Function) -> None:
        function.module.spend(function.flow.steps)
        unused: List[ast.AST] = []
        masks: List[ast.AST] = []
        changed: List[ast.AST] = []  # compared, squared, or scaled: a weight moves the threshold
        compared: List[ast.AST] = []
        numbers: List[ast.AST] = []
        for part in (part for part in function.walk() if type(part) in _USING):
            if isinstance(part, ast.Compare):
                compared += [part.left, *part.comparators]
            elif isinstance(part, ast.BinOp) and isinstance(part.op, ast.Pow):
                changed.append(part.left)
            elif isinstance(part, ast.Attribute) and part.attr in SIZES:
                unused.append(part.value)
            elif isinstance(part, ast.Call) and call_name(part) in EXTREMES and not given(part):
                changed += attribute_chain(part.func)
            elif isinstance(part, ast.Call) and call_name(part) in TRANSFORMS:
                changed += walk_expressions(part)
            elif isinstance(part, ast.AugAssign):
                unused += attribute_chain(part.target)
            elif isinstance(part, ast.Call) and call_name(part) in LEAVES:
                numbers += attribute_chain(part)
            elif isinstance(part, ast.Call) and makes_mask(part):
                masks += attribute_chain(part.func)
                masks += [node for each in given(part) for node in attribute_chain(each.value)]
        self.unused, self.masks = set(map(id, unused + numbers)), set(map(id, masks))
        self.changed, self.numbers = set(map(id, changed + compared)), set(map(id, compared + numbers))
        self._reads: Dict[str, Dict[Reaching, List[ast.Name]]] = {}  # by the name, and what reaches them
        for read in function.flow.reads:
            self._reads.setdefault(read.id, {}).setdefault(function.flow.reaching(read), []).append(read)
        self.made: Dict[int, Definition] = {}  # by the id of a value, or of what a value is the mean of over an axis
        for made in function.flow.every_definition:
            if made.kind == "assign":
                for value in (made.value, *_averaged(made.value)):
                    self.made.setdefault(id(value), made)

    def reads_of(self, made: Definition) -> List[ast.Name]:
        """Return the reads that a definition reaches."""
        reads = self._reads.get(made.place, {})
        has: Dict[Reaching, bool] = {made: True}
        for reaching in reads:
            for join in reaching.joins(has.__contains__):
                has[join] = any(has.get(part) for part in join.parts)
        return [read for reaching, some in reads.items() if has.get(reaching) for read in some]


@functools.lru_cache(maxsize=1)
def _uses(function: Function) -> _Uses:
    """Return the uses in a function, cached: its terms are asked about one after the other."""
    return _Uses(function)


def reads_of(training: Training, function: Function, form: Form) -> Tuple[List[ast.Name], List[ast.Name]]:
    """Return the reads of a named error map, logging and sizes aside; none where the map has no name of its own.

    Returns:
        The reads that are the loss, and the others: a mask or a threshold is made of them.
    """
    made = _uses(function).made.get(id(form.node)) if form.makes == "none" else None
    if made is None or "." in made.place:
        return [], []
    uses, every = _uses(function), _uses(function).reads_of(made)
    function.module.spend(len(every))
    reads = [read for read in every if id(read) not in uses.unused and not no_grad_around(function, read)]
    loss = [read for read in reads if training.includes(read) and id(read) not in uses.masks]
    averaged = made.value is not form.node
    is_changed = any(id(read) in uses.changed or (averaged and id(read) in uses.masks) for read in reads)
    others = [] if averaged else [read for read in reads if read not in loss]
    return loss, reads if is_changed else others


def _averaged(value: Optional[ast.AST]) -> Iterable[ast.AST]:
    """Return what a value is the mean of over an axis."""
    if not isinstance(value, ast.Call) or call_name(value) != "mean":
        return ()
    return (*attribute_chain(value.func), *(arg.value for arg in given(value)))


def is_measured(function: Function, form: Form) -> bool:
    """Return whether a term is only a number, ``error.mean().item()``, or compared, ``abs(height - wanted) > 0.1``."""
    uses = _uses(function)
    made = uses.made.get(id(form.node))
    reads = uses.reads_of(made) if made is not None else []
    return id(form.node) in uses.numbers or (bool(reads) and uses.numbers.issuperset(map(id, reads)))
