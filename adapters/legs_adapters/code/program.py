"""Resolve names across a checkout: find the function, class, module or library that a name refers to.

What Python decides at run time (a method of an unknown object) is looked up by its name: all candidates are returned.
"""

from __future__ import annotations

from typing import List, Optional, Tuple

import libcst as cst

from legs_adapters.code.checkout import imported_name
from legs_adapters.code.members import DEPTH, Members, Reference, unique
from legs_adapters.code.module import Class, Function, Module
from legs_adapters.code.reaching import Definition
from legs_adapters.code.syntax import arguments, call_name, dotted, path_of

__all__ = ["Program"]

_MADE = ("instance", "made by")


class Program(Members):
    """The files of a checkout, linked by the names in them."""

    def resolve(self, function: Function, node: cst.CSTNode, depth: int = 0) -> List[Reference]:
        """Return what an expression may refer to; empty where it is unknown."""
        if depth > DEPTH:
            return []
        known = self._resolved.setdefault(function, {})
        if (id(node), depth) not in known:
            found = self._resolve(function, node, depth) if function.module.spend(1) else []
            known[id(node), depth] = node, found  # the node, lest another gets its id
        return known[id(node), depth][1]

    def _resolve(self, function: Function, node: cst.CSTNode, depth: int) -> List[Reference]:
        if isinstance(node, cst.Name):
            found = self._definitions(function, node)
            if found is None:
                return self._global(function.module, node.value, depth + 1)
            references: List[Reference] = []
            for where, definition in found:
                references.extend(self.of_definition(where, definition, depth + 1))
            return unique(references)
        if isinstance(node, cst.Attribute):
            return self._attribute(function, node, depth + 1)
        if isinstance(node, cst.Call):
            if call_name(node) == "partial" and node.args:
                return self.resolve(function, node.args[0].value, depth + 1)
            if call_name(node) == "super":
                return []
            if call_name(node) in self._conventions.returning_self and isinstance(node.func, cst.Attribute):
                moved = [ref for ref in self.resolve(function, node.func.value, depth + 1) if ref.kind in _MADE]
                if moved:
                    return moved
            wrapped = self._wrapped(function, node, 0, depth + 1)
            if wrapped:
                return wrapped
            made = self.resolve(function, node.func, depth + 1)
            instances = [Reference("instance", ref.target) for ref in made if ref.kind == "class"]
            instances += [Reference("made by", ref.target) for ref in made if ref.kind == "external"]
            return unique(instances + self._returned(made, None, depth + 1))
        if isinstance(node, cst.Subscript):
            return self._subscript(function, node, depth + 1)
        if isinstance(node, cst.IfExp):
            return unique(self.resolve(function, node.body, depth + 1) + self.resolve(function, node.orelse, depth + 1))
        if isinstance(node, cst.BooleanOperation):
            return unique(self.resolve(function, node.left, depth + 1) + self.resolve(function, node.right, depth + 1))
        if isinstance(node, cst.Lambda):
            return [Reference("lambda", node)]
        return []

    def lookup(self, function: Function, node: cst.CSTNode) -> Optional[List[Tuple[Function, Definition]]]:
        """Return the definitions that a place may come from, each with its function; None if unknown."""
        return self._definitions(function, node)

    def _definitions(self, function: Function, node: cst.CSTNode) -> Optional[List[Tuple[Function, Definition]]]:
        local = function.flow.reaching(node)
        if local:
            return [(function, definition) for definition in sorted(local, key=_order)]
        place = path_of(node)
        scope = function.parent
        while place is not None and scope is not None:
            if scope.parent is None:  # the module's top level
                break
            if place in scope.flow.definitions:
                return [(scope, definition) for definition in scope.flow.definitions[place]]
            scope = scope.parent
        if place is not None and place in function.module.top.flow.definitions:
            return [(function.module.top, d) for d in function.module.top.flow.definitions[place]]
        return None

    def of_definition(self, where: Function, definition: Definition, depth: int = 0) -> List[Reference]:
        """Return what a definition may bind its place to."""
        if definition.kind in ("function", "class"):
            target = where.module.by_node.get(id(definition.node))
            return [Reference(definition.kind, target)] if target is not None else []
        if definition.kind == "import":
            return self._imported(where.module, definition, depth)
        if definition.kind in ("assign", "with") and definition.value is not None:
            return self.resolve(where, definition.value, depth)
        if definition.kind == "parameter" and definition.value is not None:
            return self.resolve(where, definition.value, depth)
        if definition.kind == "element" and definition.index is not None and isinstance(definition.value, cst.Call):
            wrapped = self._wrapped(where, definition.value, definition.index, depth)
            if wrapped:
                return wrapped
            return self._returned(self.resolve(where, definition.value.func, depth), definition.index, depth)
        return []

    def _wrapped(self, function: Function, node: cst.Call, index: int, depth: int) -> List[Reference]:
        """Resolve ``DataParallel(model)``, and ``model, optimizer = accelerator.prepare(model, optimizer)``."""
        given = arguments(node)[0] if self._wraps(node) else []
        if index >= len(given):
            return []
        return [ref for ref in self.resolve(function, given[index], depth + 1) if ref.kind == "instance"]

    def _wraps(self, node: cst.Call) -> bool:
        name = dotted(node.func) or ""
        with_dot = [known for known in self._conventions.wrapping if "." in known]
        return call_name(node) in self._conventions.wrapping or any(name.endswith(known) for known in with_dot)

    def _returned(self, made: List[Reference], index: Optional[int], depth: int) -> List[Reference]:
        """Resolve what functions return, or one of a tuple: ``render = get_renderer(kind)``, ``net = get_model()``."""
        found: List[Reference] = []
        for ref in made:
            if ref.kind != "function" or ref.guess or not isinstance(ref.target, Function) or depth > DEPTH:
                continue
            for value in ref.target.flow.returns:
                part: cst.CSTNode = value
                if index is not None:
                    if not isinstance(value, cst.Tuple) or index >= len(value.elements):
                        continue
                    part = value.elements[index].value
                if isinstance(part, (cst.Name, cst.Attribute, cst.Subscript, cst.Lambda, cst.Call)):
                    found.extend(
                        r
                        for r in self.resolve(ref.target, part, depth + 1)
                        if r.kind in ("function", "lambda", "instance") and not r.guess
                    )
        return unique(found)

    def _global(self, module: Module, name: str, depth: int) -> List[Reference]:
        if depth > DEPTH:
            return []
        definitions = module.top.flow.definitions.get(name)
        if definitions:
            references: List[Reference] = []
            for definition in definitions:
                references.extend(self.of_definition(module.top, definition, depth + 1))
            return unique(references)
        for node in module.top.flow.imports:
            if isinstance(node, cst.ImportFrom) and isinstance(node.names, cst.ImportStar):
                other = self.imported_from(module, node)
                if isinstance(other, Module) and other is not module:
                    found = self._global(other, name, depth + 1)
                    if found:
                        return found
        return []

    def _imported(self, module: Module, definition: Definition, depth: int) -> List[Reference]:
        alias, node = definition.node, definition.value
        assert isinstance(alias, cst.ImportAlias)
        name = dotted(alias.name) or ""
        if isinstance(node, cst.Import):
            full = name if alias.asname is not None else name.split(".")[0]
            found = self.find_module(module, full, 0)
            return [Reference("module", found)] if isinstance(found, Module) else [Reference("external", full)]
        assert isinstance(node, cst.ImportFrom)
        base = self.imported_from(module, node)
        inside = self.find_module(
            module, ((imported_name(node) + ".") if imported_name(node) else "") + name, len(node.relative)
        )
        if isinstance(base, Module):
            found_names = self._global(base, name, depth + 1)
            if found_names:
                return found_names
        if isinstance(inside, Module):
            return [Reference("module", inside)]
        if isinstance(base, Module):
            return []
        beside = self._on_path(module, imported_name(node), name) if imported_name(node) and not node.relative else None
        if beside is not None:
            return self._global(beside, name, depth + 1)
        return [Reference("external", f"{imported_name(node)}.{name}" if imported_name(node) else name)]

    # -- attributes

    def _attribute(self, function: Function, node: cst.Attribute, depth: int) -> List[Reference]:
        name = node.attr.value
        local = function.flow.reaching(node)
        if local:
            references: List[Reference] = []
            for definition in sorted(local, key=_order):
                references.extend(self.of_definition(function, definition, depth))
            if references:
                return unique(references)
        if isinstance(node.value, cst.Name) and node.value.value in ("self", "cls"):
            owner = self.owner_of(function)
            if owner is not None:
                return unique(self.member(owner, name, depth) + self.overrides(owner, name))
        if isinstance(node.value, cst.Call) and call_name(node.value) == "super":
            owner = self.owner_of(function)
            found = [self.member(base, name, depth) for base in self.bases(owner)] if owner is not None else []
            return unique([ref for refs in found for ref in refs])
        references = []
        for base in self.resolve(function, node.value, depth):
            if base.kind == "module":
                assert isinstance(base.target, Module)
                references.extend(self._global(base.target, name, depth))
                inner = self.find_module(base.target, name, 1)
                if inner is not None and base.target.path.endswith("__init__.py"):
                    references.append(Reference("module", inner))
            elif base.kind == "external":
                references.append(Reference("external", f"{base.target}.{name}"))
            elif base.kind in ("instance", "class"):
                assert isinstance(base.target, Class)
                references.extend(self.member(base.target, name, depth))
        if references:
            return unique(references)
        if name in self._common:
            return []
        methods = self.methods_named(name)
        if not function.module.spend(len(methods)):
            return []
        return [Reference("function", method, True) for method in methods]

    def _subscript(self, function: Function, node: cst.Subscript, depth: int) -> List[Reference]:
        definitions = self._definitions(function, node.value)
        literals: List[Tuple[Function, cst.CSTNode]] = []
        if definitions is not None:
            literals = [(where, d.value) for where, d in definitions if d.value is not None and d.kind == "assign"]
            references = []
            for where, definition in definitions:
                if definition.kind == "import":
                    references.extend(self._dictionary(where, definition, depth))
            if references:
                return unique(references)
        else:
            literals = [(function, node.value)]
        references = []
        for where, value in literals:
            references.extend(self._values(where, value, depth))
        return unique(references)

    def _dictionary(self, where: Function, definition: Definition, depth: int) -> List[Reference]:
        alias, node = definition.node, definition.value
        if not isinstance(node, cst.ImportFrom) or not isinstance(alias, cst.ImportAlias):
            return []
        base = self.imported_from(where.module, node)
        if base is None:
            return []
        references: List[Reference] = []
        for d in base.top.flow.definitions.get(dotted(alias.name) or "", []):
            if d.value is not None and d.kind == "assign":
                references.extend(self._values(base.top, d.value, depth))
        return references

    def _values(self, where: Function, value: cst.CSTNode, depth: int) -> List[Reference]:
        references: List[Reference] = []
        if isinstance(value, cst.Dict):
            for element in value.elements:
                if isinstance(element, cst.DictElement):
                    references.extend(self.resolve(where, element.value, depth))
        elif isinstance(value, cst.Call) and call_name(value) == "dict":
            for argument in arguments(value)[1].values():
                references.extend(self.resolve(where, argument, depth))
        return references


def _order(definition: Definition) -> int:
    return definition.order
