"""Resolve names across a checkout: find the function, class, module or library that a name refers to.

Where only the run time knows the class of an object, its methods are unknown.
"""

from __future__ import annotations

import ast
from typing import Dict, Iterable, Iterator, List, NamedTuple, Optional, Tuple

from legs_adapters.code.checkout import Checkout
from legs_adapters.code.limits import Budget, remembered
from legs_adapters.code.module import CALLED, Class, Function, Module
from legs_adapters.code.reaching import Definition, Reaching
from legs_adapters.code.sources import Source
from legs_adapters.code.syntax import arguments, call_name, dotted, entries, path_of

_MAX_DEPTH = 16  # how many names are followed, one to the next


class Reference(NamedTuple):
    """A function, class, module or library name that an expression refers to.

    ``kind``: "function", "class", "instance" (of a class), "module", "external" (a dotted name outside of the
    checkout), "made by" (an object that a call of such a name returned), "lambda".
    """

    kind: str
    target: object


class Program(Checkout):
    """The files of a checkout, linked by the names in them.

    Args:
        sources: the readable files.
        returning_self: methods of libraries that return the object itself, ``model.cuda()``.
        wrapping: functions that return their argument wrapped: ``DataParallel(model)``; dotted where the
            name alone is ambiguous.
        budget: what their analysis may take; default: a budget of its own.
    """

    def __init__(
        self,
        sources: Iterable[Source],
        returning_self: Iterable[str] = (),
        wrapping: Iterable[str] = (),
        budget: Optional[Budget] = None,
    ) -> None:
        super().__init__(sources, budget)
        self._returning_self = frozenset(returning_self)
        self._wrapping = tuple("." + name for name in wrapping)
        self._joined: Dict[Tuple[Reaching, int], List[Reference]] = {}  # by a join of definitions and the depth

    @remembered
    def resolve(self, function: Function, node: ast.AST, depth: int = 0) -> List[Reference]:
        """Return what an expression may refer to; empty where it is unknown."""
        if depth > _MAX_DEPTH or not function.module.spend(1):
            return []
        return list(dict.fromkeys(self._resolve(function, node, depth + 1)))

    def _resolve(self, function: Function, node: ast.AST, depth: int) -> Iterable[Reference]:
        if isinstance(node, ast.Name):
            found = self.lookup(function, node)
            return self._of(*found, depth) if found else self._member_of_module(function.module, node.id, depth)
        if isinstance(node, ast.Attribute):
            return self._attribute(function, node, depth)
        if isinstance(node, ast.Call):
            return self._call(function, node, depth)
        if isinstance(node, ast.Subscript):
            return self.resolve(function, node.value, depth)  # one of a dictionary's values, LOSSES[kind]
        if isinstance(node, ast.Dict):
            return [ref for _, value in entries(node) for ref in self.resolve(function, value, depth)]
        if isinstance(node, ast.IfExp):
            return self.resolve(function, node.body, depth) + self.resolve(function, node.orelse, depth)
        return [Reference("lambda", node)] if isinstance(node, ast.Lambda) else []

    def lookup(self, function: Function, node: ast.AST) -> Optional[Tuple[Function, Reaching]]:
        """Return the definitions that a place may come from, and their function; None if unknown."""
        local = function.flow.reaching(node)
        if local:
            return function, local
        place, scope = path_of(node), function.parent or function
        while place is not None and place not in scope.flow.definitions and scope.parent is not None:
            scope = scope.parent
        found = scope.flow.everywhere(place) if place is not None else None
        return (scope, found) if found else None

    def _of(self, where: Function, reaching: Reaching, depth: int) -> List[Reference]:
        """Return what definitions may bind their place to; of each join it is found once."""
        for join in reaching.joins(lambda part: (part, depth) in self._joined):
            found = [self._of(where, part, depth) for part in join.parts if where.module.spend(1)]
            self._joined[join, depth] = list(dict.fromkeys(ref for some in found for ref in some))
        if isinstance(reaching, Definition):
            return self.of_definition(where, reaching, depth)
        return self._joined[reaching, depth]

    def of_definition(self, where: Function, definition: Definition, depth: int = 0) -> List[Reference]:
        """Return what a definition may bind its place to."""
        value, kind = definition.value, definition.kind
        if kind in ("function", "class"):
            target = where.module.by_node.get(id(definition.node))
            return [Reference(kind, target)] if target is not None else []
        if kind == "import":
            return self._imported(where.module, definition, depth + 1)
        declared = self._declared(where, definition.node, depth) if kind == "parameter" else []
        if kind in ("assign", "with", "parameter") and value is not None:
            return declared + self.resolve(where, value, depth + 1)
        return declared

    def _declared(self, where: Function, parameter: ast.AST, depth: int) -> List[Reference]:
        """Resolve ``metric: Metric``: an instance of the class, or of one that derives from it."""
        note = getattr(parameter, "annotation", None)
        if not isinstance(note, (ast.Name, ast.Attribute)):
            return []
        named = self.resolve(where.parent or where, note, depth + 1)
        return [Reference("declared", ref.target) for ref in named if ref.kind == "class"]

    # -- calls

    def _call(self, function: Function, node: ast.Call, depth: int) -> List[Reference]:
        if call_name(node) == "partial" and node.args:
            return self.resolve(function, node.args[0], depth)
        same = self._same(function, node, depth)
        if same:
            return same
        made = self.resolve(function, node.func, depth)
        instances = [Reference("instance", ref.target) for ref in made if ref.kind == "class"]
        instances += [Reference("made by", ref.target) for ref in made if ref.kind == "external"]
        return instances + self._returned(made, depth)

    def _same(self, function: Function, node: ast.Call, depth: int) -> List[Reference]:
        """Resolve calls that return what they are given: ``model.cuda()``, ``DataParallel(model)``."""
        name, func = call_name(node), node.func
        if name in self._returning_self and isinstance(func, ast.Attribute):
            return [ref for ref in self.resolve(function, func.value, depth) if ref.kind in ("instance", "made by")]
        given = arguments(node)[0][:1] if f".{dotted(func) or name}".endswith(self._wrapping) else []
        return [ref for each in given for ref in self.resolve(function, each, depth) if ref.kind == "instance"]

    def _returned(self, made: List[Reference], depth: int) -> List[Reference]:
        """Resolve what functions return: ``render = get_renderer(kind)``."""
        callees = [ref.target for ref in made if isinstance(ref.target, Function)]
        values = [(callee, value) for callee in callees for value in callee.flow.returns]
        found = [ref for callee, value in values for ref in self.resolve(callee, value, depth + 1)]
        return [r for r in found if r.kind in ("function", "lambda", "instance")]

    # -- modules

    def _member_of_module(self, module: Module, name: str, depth: int) -> List[Reference]:
        if depth > _MAX_DEPTH:
            return []
        definitions = module.top.flow.everywhere(name)
        if definitions:
            return self._of(module.top, definitions, depth)
        for node in module.top.flow.imports:
            if isinstance(node, ast.ImportFrom) and node.names[0].name == "*":
                other = self.imported_from(module, node)
                found = self._member_of_module(other, name, depth + 1) if other not in (None, module) else []
                if found:
                    return found
        return []

    def _imported(self, module: Module, definition: Definition, depth: int) -> List[Reference]:
        alias, node = definition.node, definition.value
        assert isinstance(alias, ast.alias)
        name = alias.name
        if not isinstance(node, ast.ImportFrom):
            full = name if alias.asname is not None else name.split(".")[0]
            found = self.find_module(module, full, 0)
            return [Reference("external", full) if found is None else Reference("module", found)]
        base = self.imported_from(module, node) or self.imported_from(module, node, name)
        members = self._member_of_module(base, name, depth) if base is not None else []
        full = f"{node.module}.{name}" if node.module else name
        inside = None if members else self.find_module(module, full, node.level)
        if inside is not None:
            return [Reference("module", inside)]
        return members if base is not None else [Reference("external", full)]

    # -- attributes

    def _attribute(self, function: Function, node: ast.Attribute, depth: int) -> List[Reference]:
        name = node.attr
        if function.flow.reaching(node):
            references = self._of(function, function.flow.reaching(node), depth)
            if references:
                return references
        if isinstance(node.value, ast.Name) and node.value.id in ("self", "cls"):
            owner = self.owner_of(function)
            if owner is not None:
                return self.member(owner, name, depth) + self._overrides(owner, name)
        references = []
        for base in self.resolve(function, node.value, depth):
            if isinstance(base.target, Module):
                references += self._member_of_module(base.target, name, depth)
                inner = self.find_module(base.target, name, 1)
                if inner is not None and base.target.path.endswith("__init__.py"):
                    references.append(Reference("module", inner))
            elif isinstance(base.target, Class):
                references += self.member(base.target, name, depth)
                references += self._overrides(base.target, name) if base.kind == "declared" else []
            elif base.kind == "external":
                references.append(Reference("external", f"{base.target}.{name}"))
        return references

    # -- classes

    def owner_of(self, function: Function) -> Optional[Class]:
        """Return the class whose ``self`` a function sees."""
        while function.owner is None and function.parent is not None:
            function = function.parent
        return function.owner

    def lineage(self, owner: Class) -> Iterator[Class]:
        """Yield a class, then its base classes that are defined in the checkout, and theirs."""
        known = [owner]
        for current in known:  # which grows
            yield current
            bases = [ref.target for base in current.node.bases for ref in self.resolve(current.parent, base)]
            known += [base for base in bases if isinstance(base, Class) and base not in known]

    def member(self, owner: Class, name: str, depth: int = 0) -> List[Reference]:
        """Return what ``instance.name`` may be: a method, or a value that methods of the class store."""
        references: List[Reference] = []
        for current in self.lineage(owner) if depth <= _MAX_DEPTH else ():
            if name in current.methods:
                references.append(Reference("function", current.methods[name]))
                break
            for method, definition in current.stores(name):
                references += self.of_definition(method, definition, depth + 1)
        return list(dict.fromkeys(references))

    def _overrides(self, owner: Class, name: str) -> List[Reference]:
        """Resolve ``self.step()`` in a base class: the methods of classes that derive from it."""
        methods = self.methods_named(name) if not name.startswith("__") else []
        derived = [method for method in methods if method.owner is not None and method.owner is not owner]
        return [Reference("function", each) for each in derived if each.owner and owner in self.lineage(each.owner)]

    def run_by(self, reference: Reference) -> List[Function]:
        """Return the functions that a call of a reference runs: itself, or the ``forward`` of an instance."""
        found = [reference]
        if reference.kind == "instance" and isinstance(reference.target, Class):
            found = [ref for name in CALLED for ref in self.member(reference.target, name)]
        return [ref.target for ref in found if isinstance(ref.target, Function)]
