"""Find L1 functions that are passed as callbacks, ``self.criterion = l1_loss``: the name is replaced there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Dict, Iterator, List, NamedTuple, Optional, Set, Tuple

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.program import Program
from legs_adapters.code.syntax import code, dotted
from legs_adapters.tensors.backward import Training
from legs_adapters.terms.form import Form
from legs_adapters.terms.forms import Forms
from legs_adapters.terms.text import Edit, Text
from legs_adapters.terms.writing import Writing

__all__ = ["Callback", "Callbacks", "PassedByName"]


@dataclass(frozen=True)
class PassedByName(Form):
    """A function that is passed by name; ``node`` is the name, ``call`` the call of the callback.

    Example:
        before: loss = combined(image, gt_image, [l1_loss])
        after: [lambda input, target: legs_loss.l1_loss(input, target, own=l1_loss)]
    """

    def edits(self, text: Text, writing: Writing) -> List[Edit]:
        """Write the weighted function in the name's place; what is not the plain mean is kept as ``own=``."""
        assert self.callee is not None
        function = f"{writing.package}.l1_loss"
        if not self.is_mean:
            function = f"lambda input, target: {function}(input, target, own={code(self.callee)})"
        return [text.replace(*text.span(self.node, True), function)]


class Callback(NamedTuple):
    """A callback: the form to replace, and the function in which it is called.

    ``outer`` is the call that passes it, for one of a list: one function may get images and depths.
    """

    form: Form
    caller: Function
    outer: Optional[cst.Call] = None


class Callbacks:
    """The callbacks of one program, found on first use."""

    def __init__(self, program: Program, training: Training, forms: Forms) -> None:
        self._program = program
        self._training = training
        self._forms = forms
        self._assigned: Set[Function] = set()
        self._by_holder: Optional[Dict[Function, List[Callback]]] = None

    def of(self, holder: Function) -> List[Callback]:
        """Return the callbacks that a function, or a module's top level, passes."""
        return self._found().get(holder, [])

    def includes(self, function: Function) -> bool:
        """Return whether an L1 function is assigned to a name that is called."""
        self._found()  # which fills them
        return function in self._assigned

    def _found(self) -> Dict[Function, List[Callback]]:
        if self._by_holder is None:
            self._by_holder = {}
            for function in list(self._training.sites):
                self._add_assigned(function)
            for function in list(self._training.sites):
                self._add_listed(function)
        return self._by_holder

    def _add(self, holder: Function, callback: Callback) -> None:
        assert self._by_holder is not None
        self._by_holder.setdefault(holder, []).append(callback)

    def _add_assigned(self, function: Function) -> None:
        """Add names that are assigned an L1 function, ``self.criterion = l1_loss``, and that training calls."""
        own, calls = self._forms.functions, self._training.sites[function]
        shape = own.shape(function)
        if shape is None:
            return
        known = {id(form.call) for caller, _ in calls for form in self._forms.of(caller)}
        unknown = [
            (caller, call)
            for caller, call in calls
            if id(call) not in known and own.shape(caller) is None and len(call.args) == 2
        ]
        for holder in self._program.mentioning(function.name) if unknown else ():
            for definition in holder.flow.every_definition:
                value = definition.value
                if definition.kind != "assign" or not isinstance(value, (cst.Name, cst.Attribute)):
                    continue
                references = self._program.resolve(holder, value)
                if [r.target for r in references] != [function] or references[0].guess:
                    continue
                if not _is_read(holder, definition.place):
                    continue
                self._assigned.add(function)
                near = [(c, call) for c, call in unknown if c.module is holder.module] or unknown
                caller, call = near[0]
                sides = call.args[0].value, call.args[1].value
                self._add(holder, Callback(PassedByName(value, call, *sides, value, makes=shape), caller))

    def _add_listed(self, function: Function) -> None:
        """Add the functions of a list, ``on_crops(image, gt, [l1, other])``, which ``losses[i](image, gt)`` calls."""
        for call in function.flow.calls:
            table = call.func.value if isinstance(call.func, cst.Subscript) else None
            if not isinstance(table, cst.Name) or len(call.args) != 2:
                continue
            if {definition.kind for definition in function.flow.reaching(table)} != {"parameter"}:
                continue
            for caller, outer in self._training.sites[function]:
                given = function.given(outer, table.value)
                for element in given.elements if isinstance(given, cst.List) else ():
                    if self._forms.functions.is_l1(caller, element.value):
                        sides = call.args[0].value, call.args[1].value
                        form = PassedByName(element.value, call, *sides, element.value)
                        self._add(caller, Callback(form, function, outer))

    def uncalled(self, function: Function) -> Iterator[Tuple[str, cst.BaseExpression]]:
        """Yield names that are assigned L1 functions and have no call in the codebase, each with the L1."""
        known = {id(callback.form.node) for callback in self.of(function)}
        for form in self._forms.of(function):  # and what is called by a name of its own
            named = function.flow.reaching(form.callee) if form.callee is not None else ()
            known |= {id(definition.value) for definition in named}
        for definition in function.flow.every_definition:
            value = definition.value
            if definition.kind != "assign" or id(value) in known or not isinstance(value, (cst.Name, cst.Attribute)):
                continue
            if self._forms.functions.is_l1(function, value) and not self._is_called(function, definition.place):
                yield definition.place, value

    def _is_called(self, function: Function, place: str) -> bool:
        """Return whether ``self.loss`` is called by another method of its class."""
        owner = self._program.owner_of(function)
        methods = owner.methods.values() if owner is not None and place.startswith("self.") else ()
        return any(dotted(call.func) == place for method in methods for call in method.flow.calls)


def _is_read(holder: Function, place: str) -> bool:
    """Return whether a function, or one in it, reads a local name; other places may be read elsewhere."""
    if holder.parent is None or "." in place:
        return True
    return any(read.value == place for each in (holder, *holder.inner) for read in each.flow.reads)
