"""Find L1 functions that are passed by name, ``self.criterion = l1_loss``: the name is replaced there.

NeRFICG, and FasterGS in it, registers them, ``self.add_loss_metric('L1_Color', torch.nn.functional.l1_loss, weight)``,
and calls them later with ``input=`` and ``target=``.
"""

from __future__ import annotations

import ast
from dataclasses import dataclass
from typing import Dict, Iterator, List, Optional, Set

from legs_adapters.code.module import Function
from legs_adapters.code.program import Program
from legs_adapters.code.syntax import arguments, call_name, code, constant, dotted, given
from legs_adapters.lexicon.names import is_l1_name, kind_of_words
from legs_adapters.tensors.backward import Training
from legs_adapters.terms.form import Form
from legs_adapters.terms.forms import Forms
from legs_adapters.terms.text import Edit, Text
from legs_adapters.terms.writing import PACKAGE, Writing


@dataclass(frozen=True)
class PassedByName(Form):
    """A function that is passed by name; ``node`` is the name, ``call`` the call of the callback, in ``caller``.

    Examples:
        before: criterion = F.mse_loss; if dataset: criterion = l1_loss; loss = criterion(image, gt_image)
        after: if dataset: criterion = legs_loss.l1_loss
    """

    caller: Optional[Function] = None

    def edits(self, text: Text, writing: Writing) -> List[Edit]:
        """Write the weighted function in the name's place; what is not the plain mean is kept as ``own=``."""
        assert self.callee is not None
        function = f"{PACKAGE}.l1_loss"
        if self.makes != "mean":
            function = f"lambda input, target: {function}(input, target, own={code(self.callee)})"
        return [text.replace(*text.span(self.node), function)]


class Callbacks:
    """The callbacks of one program: L1 functions that are assigned to names, and that training calls by these."""

    def __init__(self, program: Program, training: Training, forms: Forms) -> None:
        self.assigned: Set[Function] = set()
        self._program = program
        self._training = training
        self._forms = forms
        self._by_holder: Dict[Function, List[PassedByName]] = {}
        for function in list(training.sites):
            if forms.functions.shape(function) is not None:
                self._add(function)

    def assigned_in(self, holder: Function) -> List[PassedByName]:
        """Return the callbacks that a function, or a module's top level, assigns."""
        return self._by_holder.get(holder, [])

    def registered_in(self, function: Function) -> Iterator[PassedByName]:
        """Yield the photometric L1 functions that a function registers; ``node`` is the registered callable."""
        for call in function.flow.calls if "add_loss_metric" in function.text else ():
            positional, keywords, _ = arguments(call)
            name = constant(keywords.get("name", positional[0] if positional else None))
            metric = keywords.get("metric", positional[1] if len(positional) > 1 else None)
            is_of_images = isinstance(name, str) and kind_of_words(name) in ("image", None)
            if call_name(call) == "add_loss_metric" and metric is not None and is_of_images:
                targets = [reference.target for reference in self._program.resolve(function, metric)]
                names = [str(getattr(target, "name", target)) for target in targets] or [dotted(metric) or ""]
                if all(is_l1_name(each.split(".")[-1]) for each in names):
                    first, second = (ast.Name(side, ast.Load()) for side in ("input", "target"))
                    yield PassedByName(metric, call, first, second, metric)

    def _add(self, function: Function) -> None:
        shape, calls = self._forms.functions.shape, self._training.sites[function]
        known = {id(form.call) for caller in dict(calls) for form in self._forms.in_function(caller)}
        by_name = [site for site in calls if id(site[1]) not in known and len(given(site[1])) == 2]
        by_name = [(caller, call) for caller, call in by_name if shape(caller) is None]
        for holder in self._program.mentioning(function.name) if by_name else ():
            near = [(caller, call) for caller, call in by_name if caller.module is holder.module]
            caller, call = (near or by_name)[0]
            first, second = (arg.value for arg in given(call))
            for value in self._values(holder, function):
                form = PassedByName(value, call, first, second, value, makes=shape(function) or "own", caller=caller)
                self._by_holder.setdefault(holder, []).append(form)
                self.assigned.add(function)

    def _values(self, holder: Function, function: Function) -> Iterator[ast.expr]:
        """Yield the assigned values in one function that are another function, by its name."""
        reads = {read.id for read in holder.flow.reads}
        for made in holder.flow.every_definition:
            is_called = "." in made.place or holder.parent is None or made.place in reads
            if made.kind == "assign" and isinstance(made.value, (ast.Name, ast.Attribute)) and is_called:
                references = self._program.resolve(holder, made.value)
                if [r.target for r in references] == [function]:
                    yield made.value
