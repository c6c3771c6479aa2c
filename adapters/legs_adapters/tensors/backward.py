"""Compute the backward slice of every ``.backward()``: the expressions that its value comes from, across files."""

from __future__ import annotations

import re
from typing import Callable, Dict, List, Optional, Set, Tuple

import libcst as cst

from legs_adapters.code.calls import given_to, handed
from legs_adapters.code.module import Class, Function
from legs_adapters.code.program import Program
from legs_adapters.code.reaching import Definition
from legs_adapters.code.syntax import arguments, call_name, children, constant, key_of
from legs_adapters.tensors.operations import BACKWARD, ENDS_GRADIENT, HOOKS, SIZES
from legs_adapters.tensors.steps import is_backward

__all__ = ["Training"]

_BACKWARD = re.compile(r"\b(manual_)?backward\s*\(")
_HOOK = re.compile(rf"def\s+({'|'.join(sorted(HOOKS))})\s*\(")
_ANY = object()


class Training:
    """The slice of a program that its backward passes depend on.

    Args:
        matters: a predicate on the text of a function: the slice does not enter functions where it is false.

    Attributes:
        roots: the functions that call ``.backward()`` or return what a framework trains on.
        sites: for a function that contributes, the calls (each with its caller) through which it does.
    """

    def __init__(self, program: Program, matters: Callable[[str], bool]) -> None:
        self.program = program
        self._may_matter = matters
        self.roots: List[Function] = []
        self.sites: Dict[Function, List[Tuple[Function, cst.Call]]] = {}
        self._trained: Set[int] = set()
        self._touched: Set[Function] = set()
        self._met: Set[Tuple[Function, int]] = set()  # what ``sites`` has
        self._done: Set[Tuple[int, object]] = set()
        self._work: List[Tuple[Function, cst.CSTNode, object]] = []
        for module in program.matching(_BACKWARD):
            for function in module.scopes(_BACKWARD.search):
                self._start(function)
        for module in program.matching(_HOOK):
            for function in (f for name in sorted(HOOKS) for f in module.named(name)):
                if function.owner is not None:
                    self._root(function)
                    for value in function.flow.returns:
                        self._push(function, value)
        self._run()

    def includes(self, node: cst.CSTNode) -> bool:
        """Return whether a backward pass reaches this expression."""
        return id(node) in self._trained

    def touches(self, function: Function) -> bool:
        """Return whether a backward pass reaches an expression of this function."""
        return function in self._touched

    # -- roots

    def _root(self, function: Function) -> None:
        if function not in self.roots:
            self.roots.append(function)

    def _start(self, function: Function) -> None:
        for call in function.flow.calls:
            if not is_backward(call):
                continue
            self._root(function)
            values = [arg.value for arg in call.args if arg.keyword is None or arg.keyword.value in ("loss", "tensors")]
            if isinstance(call.func, cst.Attribute):
                values.append(call.func.value)
            for value in values:
                self._push(function, value)
                self._upwards(function, value)

    def _upwards(self, function: Function, value: cst.CSTNode) -> None:
        """Follow ``def step(loss): loss.backward()`` to its calls, which pass the trained value."""
        for definition in function.flow.reaching(value):
            if definition.kind != "parameter" or definition.place not in function.parameters:
                continue
            for caller, given in given_to(self.program, function, definition.place):
                if given is not None:
                    self._push(caller, given)

    # -- the slice

    def _push(self, function: Function, node: cst.CSTNode, key: object = _ANY) -> None:
        mark = (id(node), key if isinstance(key, (str, int)) else _ANY)
        if mark not in self._done:
            self._done.add(mark)
            self._work.append((function, node, key))

    def _run(self) -> None:
        while self._work:
            function, node, key = self._work.pop()
            if function.module.spend(1):
                self._touched.add(function)
                self._visit(function, node, key)

    def _visit(self, function: Function, node: cst.CSTNode, key: object) -> None:
        """Mark what ``node`` (or, with a key, ``node[key]``) gets its value from."""
        if (
            isinstance(key, int)
            and isinstance(node, (cst.Tuple, cst.List))
            and -len(node.elements) <= key < len(node.elements)
        ):
            self._push(function, node.elements[key].value)
            return
        if key is not _ANY and isinstance(node, cst.Dict):
            literal = [e for e in node.elements if isinstance(e, cst.DictElement)]
            matching = [e for e in literal if constant(e.key) == key]
            if matching and len(literal) == len(node.elements):
                for element in matching:
                    self._push(function, element.value)
                return
        self._trained.add(id(node))
        if isinstance(node, cst.Call):
            self._call(function, node, key)
        elif isinstance(node, (cst.Name, cst.Attribute)):
            if not (isinstance(node, cst.Attribute) and node.attr.value in SIZES):
                self._place(function, node, key)
        elif isinstance(node, cst.Subscript):
            if not self._place(function, node, key):
                inner = key_of(node)
                self._push(function, node.value, _ANY if inner is None else inner)
        elif isinstance(node, (cst.GeneratorExp, cst.ListComp, cst.SetComp)):
            self._push(function, node.elt)
            self._loops(function, node.for_in)
        elif isinstance(node, cst.DictComp):
            self._push(function, node.value)
            self._loops(function, node.for_in)
        elif isinstance(node, cst.Lambda):
            self._push(function, node.body)
        elif isinstance(node, cst.IfExp):
            self._push(function, node.body, key)
            self._push(function, node.orelse, key)
        elif isinstance(node, cst.Comparison):
            return
        else:
            for child in children(node):
                self._push(function, child)

    def _loops(self, function: Function, loop: Optional[cst.CompFor]) -> None:
        while loop is not None:
            self._push(function, loop.iter)
            loop = loop.inner_for_in

    def _call(self, function: Function, node: cst.Call, key: object) -> None:
        name = call_name(node)
        if name in ENDS_GRADIENT | SIZES | BACKWARD and isinstance(node.func, cst.Attribute):
            return
        if (
            isinstance(node.func, cst.Attribute)
            and name == "get"
            and node.args
            and isinstance(constant(node.args[0].value), str)
        ):
            self._push(function, node.func.value, constant(node.args[0].value))
            return
        if isinstance(node.func, cst.Name) and name == "dict" and isinstance(key, str):
            keywords = arguments(node)[1]
            if key in keywords:
                self._push(function, keywords[key])
                return
        references = self.program.resolve(function, node.func)
        if not references and isinstance(node.func, cst.Name):
            references = handed(self.program, function, node.func)
        for reference in references:
            if reference.kind == "lambda" and isinstance(reference.target, cst.Lambda):
                self._push(function, reference.target)
            for callee in self.program.run_by(reference):
                self._called(function, node, callee)
                self._returned(callee, key)
        for arg in node.args:
            self._push(function, arg.value)
        if isinstance(node.func, cst.Attribute):
            self._push(function, node.func.value)
        elif not isinstance(node.func, cst.Name):
            self._push(function, node.func)

    def _called(self, caller: Function, call: cst.Call, callee: Function) -> None:
        """Record a call through which a function contributes."""
        if (callee, id(call)) not in self._met:
            self._met.add((callee, id(call)))
            self.sites.setdefault(callee, []).append((caller, call))

    def _returned(self, function: Function, key: object = _ANY) -> None:
        if self._matters(function):
            for value in function.flow.returns:
                self._push(function, value, key)

    def _matters(self, function: Function) -> bool:
        return self._may_matter(function.text)

    def _place(self, function: Function, node: cst.CSTNode, key: object) -> bool:
        definitions = self.program.lookup(function, node)
        if isinstance(node, cst.Name) and (isinstance(key, str) or _begins_empty(definitions)):
            self._filled_in(function, node, key)
        if definitions:
            for where, definition in definitions:
                self._definition(where, definition, key)
            return True
        if isinstance(node, cst.Attribute):
            if isinstance(node.value, cst.Name) and node.value.value == "self":
                owner = self.program.owner_of(function)
                stores = self._stores(owner, node.attr.value) if owner is not None else []
                for method, definition in stores:
                    self._definition(method, definition, key)
            else:
                self._push(function, node.value, "." + node.attr.value)
        return False

    def _filled_in(self, function: Function, node: cst.Name, key: object) -> None:
        """Follow ``self.compute(image, output)``, which puts ``output["loss"]`` into the dictionary trained on."""
        for call in function.flow.calls if function.module.spend(len(function.flow.calls)) else ():
            positional, keywords, starred = arguments(call)
            named: List[Tuple[object, cst.BaseExpression]] = [*enumerate(positional), *keywords.items()]
            for name, value in named:
                if not isinstance(value, cst.Name) or value.value != node.value or starred:
                    continue
                for reference in self.program.resolve(function, call.func):
                    callee = reference.target
                    if reference.kind != "function" or not isinstance(callee, Function) or not self._matters(callee):
                        continue
                    names = callee.parameters
                    parameter = name if isinstance(name, str) else ""
                    if isinstance(name, int) and name < len(names):
                        parameter = names[name]
                    stores = [d for d in callee.flow.definitions.get(parameter, []) if d.kind in ("store", "mutate")]
                    if isinstance(key, str):
                        stores += callee.flow.definitions.get(f"{parameter}[{key!r}]", [])
                    if stores:
                        self._called(function, call, callee)
                    for definition in stores:
                        self._definition(callee, definition, key)

    def _stores(self, owner: Class, attribute: str) -> List[Tuple[Function, Definition]]:
        owners = [owner, *self.program.bases(owner)]
        return [entry for one in owners for entry in one.stores(attribute, self._matters)]

    def _definition(self, function: Function, definition: Definition, key: object) -> None:
        value = definition.value
        if definition.kind in ("function", "import", "class"):
            for reference in self.program.of_definition(function, definition):
                if reference.kind == "function" and isinstance(reference.target, Function):
                    self._returned(reference.target)
            return
        if definition.kind == "store":
            if definition.key is not None and key is not _ANY and definition.key != key:
                return
            if value is not None:
                self._push(function, value)
            return
        if definition.kind == "augment":
            assert isinstance(definition.node, cst.AugAssign)
            self._push(function, definition.node.target, key)
            if value is not None:
                self._push(function, value)
            return
        if value is None:
            return
        if definition.kind == "element":
            self._push(function, value, _ANY if definition.index is None else definition.index)
        elif definition.kind == "part":
            self._push(function, value)
        elif definition.kind in ("mutate", "inplace") and isinstance(value, cst.Call):
            for arg in value.args:
                self._push(function, arg.value, key if call_name(value) == "update" else _ANY)
        else:
            self._push(function, value, key)


def _begins_empty(definitions: Optional[List[Tuple[Function, Definition]]]) -> bool:
    """Return whether a dictionary is empty where it is made, ``losses = {}``, and filled before it is returned."""
    values = [definition.value for _, definition in definitions or () if definition.kind == "assign"]
    return bool(values) and all(isinstance(value, cst.Dict) and not value.elements for value in values)
