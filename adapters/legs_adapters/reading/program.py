"""A checkout as one program: its modules, functions and classes, and what a name in one of them refers to.

Files are parsed when they are first asked for. What Python decides at run time (a method of an unknown object) is
looked up by its name: everything that it could be is returned.
"""

from __future__ import annotations

import re
from pathlib import PurePosixPath
from typing import Callable, Dict, Iterable, List, Mapping, NamedTuple, Optional, Set, Tuple

import libcst as cst

from legs_adapters.reading.flow import Definition
from legs_adapters.reading.module import Class, Function, Module, parse
from legs_adapters.reading.prospects import Prospects
from legs_adapters.reading.repo import Source, Unreadable
from legs_adapters.reading.syntax import arguments, call_name, dotted, path_of, word_set

__all__ = ["Program", "Reference"]

_DEFINED = re.compile(r"^[ \t]*(?:async[ \t]+)?(?:def|class)[ \t]+(\w+)", re.M)
_COMMON = word_set(
    """
    __init__ get items keys values copy to cuda cpu clone detach load save append update mean sum size step
    zero_grad train eval close write read format join split pop item view reshape permute squeeze unsqueeze
    clamp
    """
)
_DEPTH = 12
_MADE = ("instance", "made by")
_MOVES = {"cuda", "cpu", "to", "half", "float", "double", "eval", "train", "requires_grad_"}  # give the module itself
# Give what does as the module that they are given does.
_WRAPS = {"DataParallel", "DistributedDataParallel", "DDP", "compile", "convert_sync_batchnorm", "prepare"}


class Reference(NamedTuple):
    """What an expression refers to.

    ``kind``: "function", "class", "instance" (of a class), "module", "external" (a dotted name outside of the
    checkout), "lambda". ``guess``: found by its name alone.
    """

    kind: str
    target: object
    guess: bool = False


class Program:
    """The files of a checkout, linked.

    Args:
        sources: the readable files.
        unread: by path, the text of those that are not to be looked at, or cannot be: all that is asked of it is
            whether it says a name.

    Attributes:
        prospects: which texts can lead to an L1.
        only_differences: of which functions it is known whether they are an L1 of their first two parameters.
    """

    def __init__(self, sources: Iterable[Source], unread: Optional[Mapping[str, str]] = None) -> None:
        self.unread = unread or {}
        self.sources: Dict[str, Source] = {source.path: source for source in sources}
        self._unreadable: Dict[str, Unreadable] = {}
        self.prospects = Prospects(source.text for source in self.sources.values())
        self.only_differences: Dict[Function, bool] = {}
        self._modules: Dict[str, Optional[Module]] = {}
        self._mentions: Dict[Tuple[str, bool], List[Function]] = {}
        self._defined: Dict[str, List[str]] = {}
        self._together: Dict[str, Set[str]] = {}
        self._ending: Dict[str, List[str]] = {}  # by the last name of what is imported of them
        for source in self.sources.values():
            path = PurePosixPath(source.path)
            last = path.parent.name if path.name == "__init__.py" else path.stem
            self._ending.setdefault(last, []).append(source.path)
            for name in set(_DEFINED.findall(source.text)):
                self._defined.setdefault(name, []).append(source.path)

    def module(self, path: str) -> Optional[Module]:
        """Return a parsed file; None where it does not parse (it is then among ``unreadable``)."""
        if path not in self._modules:
            parsed = parse(self.sources[path])
            if isinstance(parsed, Unreadable):
                self._unreadable[path] = parsed
            self._modules[path] = parsed if isinstance(parsed, Module) else None
        return self._modules[path]

    @property
    def unreadable(self) -> Dict[str, Unreadable]:
        """Files that turned out not to parse, by path, each with the reason."""
        failed = {m.path: m.failure for m in self._modules.values() if m is not None and m.failure is not None}
        return {**self._unreadable, **failed}

    def give_up(self, path: str, reason: str) -> None:
        """Count a file as unreadable."""
        self._unreadable[path] = Unreadable(path, reason)

    def matching(self, pattern: re.Pattern[str]) -> List[Module]:
        """Return the modules whose text matches."""
        found = [self.module(path) for path, source in self.sources.items() if pattern.search(source.text)]
        return [module for module in found if module is not None]

    def mentioning(self, name: str, called: bool = False) -> List[Function]:
        """Return the functions and top levels whose text mentions a name, or calls it."""
        pattern = re.compile(r"\b" + re.escape(name) + (r"\s*\(" if called else r"\b"))

        def says(text: str) -> bool:
            return name in text and pattern.search(text) is not None

        if (name, called) not in self._mentions:
            modules = [self.module(path) for path, source in self.sources.items() if says(source.text)]
            self._mentions[name, called] = [f for module in modules if module is not None for f in module.scopes(says)]
        return self._mentions[name, called]

    # -- names

    def resolve(self, function: Function, node: cst.CSTNode, depth: int = 0) -> List[Reference]:
        """Return what an expression may refer to; empty where nothing is known."""
        if depth > _DEPTH:
            return []
        if isinstance(node, cst.Name):
            found = self._definitions(function, node)
            if found is None:
                return self._global(function.module, node.value, depth + 1)
            references: List[Reference] = []
            for where, definition in found:
                references.extend(self._of_definition(where, definition, depth + 1))
            return _unique(references)
        if isinstance(node, cst.Attribute):
            return self._attribute(function, node, depth + 1)
        if isinstance(node, cst.Call):
            if call_name(node) == "partial" and node.args:
                return self.resolve(function, node.args[0].value, depth + 1)
            if call_name(node) == "super":
                return []
            if call_name(node) in _MOVES and isinstance(node.func, cst.Attribute):
                moved = [ref for ref in self.resolve(function, node.func.value, depth + 1) if ref.kind in _MADE]
                if moved:
                    return moved
            wrapped = self._wrapped(function, node, 0, depth + 1)
            if wrapped:
                return wrapped
            made = self.resolve(function, node.func, depth + 1)
            instances = [Reference("instance", ref.target) for ref in made if ref.kind == "class"]
            instances += [Reference("made by", ref.target) for ref in made if ref.kind == "external"]
            return _unique(instances + self._returned(made, None, depth + 1))
        if isinstance(node, cst.Subscript):
            return self._subscript(function, node, depth + 1)
        if isinstance(node, cst.IfExp):
            return _unique(
                self.resolve(function, node.body, depth + 1) + self.resolve(function, node.orelse, depth + 1)
            )
        if isinstance(node, cst.BooleanOperation):
            return _unique(self.resolve(function, node.left, depth + 1) + self.resolve(function, node.right, depth + 1))
        if isinstance(node, cst.Lambda):
            return [Reference("lambda", node)]
        return []

    def lookup(self, function: Function, node: cst.CSTNode) -> Optional[List[Tuple[Function, Definition]]]:
        """Return the definitions that a place may come from, each with the function it stands in; None if unknown."""
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

    def _of_definition(self, where: Function, definition: Definition, depth: int) -> List[Reference]:
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

    def handed(self, function: Function, node: cst.Name) -> List[Reference]:
        """The modules that a parameter is given, ``model`` of ``train_epoch(model, loader)``."""
        kinds = {definition.kind for definition in function.flow.reaching(node)}
        if not function.name or kinds - {"store"} != {"parameter"}:
            return []
        return _unique(
            reference
            for caller in self.mentioning(function.name, called=True)
            for call in caller.flow.calls
            if caller is not function and call_name(call) == function.name
            for value in [function.given(call, node.value)]
            if value is not None
            for reference in self.resolve(caller, value)
            if reference.kind == "instance"
        )

    def _wrapped(self, function: Function, node: cst.Call, index: int, depth: int) -> List[Reference]:
        """``DataParallel(model)``, ``model, optimizer = accelerator.prepare(model, optimizer)``."""
        wraps = call_name(node) in _WRAPS or (dotted(node.func) or "").endswith("fabric.setup")
        given = arguments(node)[0] if wraps else []
        if index >= len(given):
            return []
        return [ref for ref in self.resolve(function, given[index], depth + 1) if ref.kind == "instance"]

    def _returned(self, made: List[Reference], index: Optional[int], depth: int) -> List[Reference]:
        """What functions return, or one of those in a tuple: ``render = get_renderer(kind)``, ``net = get_model()``."""
        found: List[Reference] = []
        for ref in made:
            if ref.kind != "function" or ref.guess or not isinstance(ref.target, Function) or depth > _DEPTH:
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
        return _unique(found)

    def _global(self, module: Module, name: str, depth: int) -> List[Reference]:
        if depth > _DEPTH:
            return []
        definitions = module.top.flow.definitions.get(name)
        if definitions:
            references: List[Reference] = []
            for definition in definitions:
                references.extend(self._of_definition(module.top, definition, depth + 1))
            return _unique(references)
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
        inside = self.find_module(module, ((_from(node) + ".") if _from(node) else "") + name, len(node.relative))
        if isinstance(base, Module):
            found_names = self._global(base, name, depth + 1)
            if found_names:
                return found_names
        if isinstance(inside, Module):
            return [Reference("module", inside)]
        if isinstance(base, Module):
            return []
        beside = self._on_path(module, _from(node), name) if _from(node) and not node.relative else None
        if beside is not None:
            return self._global(beside, name, depth + 1)
        return [Reference("external", f"{_from(node)}.{name}" if _from(node) else name)]

    def imported_from(self, module: Module, node: cst.ImportFrom) -> Optional[Module]:
        """Return the checkout's module that ``from ... import`` in another takes from."""
        return self.find_module(module, _from(node), len(node.relative))

    def together(self, module: Module) -> Set[str]:
        """Return the paths of the files that run together with another: what is imported by whatever imports it.

        What functions import, or is loaded by its name, is not seen.
        """
        if module.path not in self._together:
            users = _closure([module], self._users)
            self._together[module.path] = {found.path for found in _closure(users, self._imports)}
        return self._together[module.path]

    def _users(self, module: Module) -> List[Module]:
        """The modules that import another."""
        path = PurePosixPath(module.path)
        name = path.parent.name if path.name == "__init__.py" else path.stem
        return [other for other in self.matching(re.compile(rf"\b{name}\b")) if module in self._imports(other)]

    def _imports(self, module: Module) -> List[Module]:
        """The checkout's modules that a module imports."""
        found: List[Optional[Module]] = []
        for node in module.top.flow.imports:
            assert isinstance(node, (cst.Import, cst.ImportFrom))
            names = [] if isinstance(node.names, cst.ImportStar) else [dotted(alias.name) or "" for alias in node.names]
            if isinstance(node, cst.ImportFrom):
                stem, level = _from(node), len(node.relative)
                base = self.imported_from(module, node)
                found.append(base)
                if base is None and stem and not level:
                    found.extend(self._on_path(module, stem, name) for name in names)
                found.extend(self.find_module(module, f"{stem}.{name}" if stem else name, level) for name in names)
            else:
                found.extend(self.find_module(module, name, 0) for name in names)
        return [other for other in found if other is not None]

    def find_module(self, module: Module, name: str, level: int) -> Optional[Module]:
        """Return the checkout's module of this name, as seen from another; None where it is not the checkout's."""
        here = PurePosixPath(module.path).parent
        inner = name.replace(".", "/")
        if level:
            for _ in range(level - 1):
                here = here.parent
            candidates = [here]
        else:
            candidates = [here, *here.parents, PurePosixPath("src")]
        for base in candidates:
            stem = (base / inner).as_posix() if inner else base.as_posix()
            for path in (f"{stem}.py", f"{stem}/__init__.py" if stem != "." else "__init__.py"):
                path = path[2:] if path.startswith("./") else path
                if path in self.sources:
                    return self.module(path)
        if level or not inner:
            return None
        # Scripts put folders on sys.path: the one file whose path ends so is it, or the one nearest by.
        known = self._ending.get(inner.rpartition("/")[2], []) if "/" in inner else []
        ends = _nearest(module.path, [p for p in known if p.endswith((f"/{inner}.py", f"/{inner}/__init__.py"))])
        return self.module(ends[0]) if len(ends) == 1 else None

    def _on_path(self, module: Module, stem: str, name: str) -> Optional[Module]:
        """``from base import Trainer``: the nearest ``base.py`` that defines a Trainer, if a script can have put it
        on sys.path; of a checkout that is a package itself also ``from its_name.base import Trainer``."""
        defines = re.compile(rf"^(?:class|def)[ \t]+{re.escape(name)}\b", re.M)
        own = stem.partition(".")[2].replace(".", "/") + ".py" if "__init__.py" in self.sources else ""
        known = [own] if own in self.sources else self._ending.get(stem, [])
        ends = [p for p in known if defines.search(self.sources[p].text)]
        ends = _nearest(module.path, ends)
        return self.module(ends[0]) if len(ends) == 1 else None

    # -- attributes

    def _attribute(self, function: Function, node: cst.Attribute, depth: int) -> List[Reference]:
        name = node.attr.value
        local = function.flow.reaching(node)
        if local:
            references: List[Reference] = []
            for definition in sorted(local, key=_order):
                references.extend(self._of_definition(function, definition, depth))
            if references:
                return _unique(references)
        if isinstance(node.value, cst.Name) and node.value.value in ("self", "cls"):
            owner = self.owner_of(function)
            if owner is not None:
                return _unique(self.member(owner, name, depth) + self._overrides(owner, name))
        if isinstance(node.value, cst.Call) and call_name(node.value) == "super":
            owner = self.owner_of(function)
            found = [self.member(base, name, depth) for base in self.bases(owner)] if owner is not None else []
            return _unique([ref for refs in found for ref in refs])
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
            return _unique(references)
        if name in _COMMON:
            return []
        return [Reference("function", method, True) for method in self.methods_named(name)]

    def owner_of(self, function: Function) -> Optional[Class]:
        """Return the class whose ``self`` a function sees."""
        scope: Optional[Function] = function
        while scope is not None:
            if scope.owner is not None:
                return scope.owner
            scope = scope.parent
        return None

    def _overrides(self, owner: Class, name: str) -> List[Reference]:
        """``self.step()`` in a base class: the methods of classes that derive from it."""
        if name.startswith("__"):
            return []
        found = []
        for method in self.methods_named(name) if name not in _COMMON else []:
            assert method.owner is not None
            if method.owner is not owner and self._derives(method.owner, owner):
                found.append(Reference("function", method))
        return found

    def _derives(self, derived: Class, owner: Class) -> bool:
        seen: Set[int] = set()
        queue = self.bases(derived)
        while queue:
            current = queue.pop()
            if current is owner:
                return True
            if id(current) not in seen:
                seen.add(id(current))
                queue.extend(self.bases(current))
        return False

    def bases(self, owner: Class) -> List[Class]:
        """Return the base classes that stand in the checkout."""
        found = []
        for arg in owner.node.bases:
            for ref in self.resolve(owner.parent, arg.value):
                if ref.kind == "class" and isinstance(ref.target, Class) and ref.target is not owner:
                    found.append(ref.target)
        return found

    def member(self, owner: Class, name: str, depth: int = 0) -> List[Reference]:
        """Return what ``instance.name`` may be: a method, or what methods of the class store there."""
        references: List[Reference] = []
        seen: Set[int] = set()
        queue = [owner]
        while queue and depth <= _DEPTH:
            current = queue.pop(0)
            if id(current) in seen:
                continue
            seen.add(id(current))
            if name in current.methods:
                references.append(Reference("function", current.methods[name]))
                break
            if name in current.fields:
                references.extend(self.resolve(current.parent, current.fields[name], depth + 1))
            for method, definition in current.stores(name):
                references.extend(self._of_definition(method, definition, depth + 1))
            queue.extend(self.bases(current))
        return _unique(references)

    def methods_named(self, name: str) -> List[Function]:
        """Return every method of this name in the checkout."""
        found: List[Function] = []
        for path in self._defined.get(name, []):
            module = self.module(path)
            if module is not None:
                found.extend(f for f in module.named(name) if f.owner is not None)
        return found

    def functions_named(self, name: str) -> List[Function]:
        """Return every function or method of this name in the checkout."""
        found: List[Function] = []
        for path in self._defined.get(name, []):
            module = self.module(path)
            if module is not None:
                found.extend(module.named(name))
        return found

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
                return _unique(references)
        else:
            literals = [(function, node.value)]
        references = []
        for where, value in literals:
            references.extend(self._values(where, value, depth))
        return _unique(references)

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


def _closure(modules: Iterable[Module], following: Callable[[Module], List[Module]]) -> List[Module]:
    """Return the modules, and what follows from them, and from that."""
    found: Dict[str, Module] = {}
    work = list(modules)
    while work:
        module = work.pop()
        if module.path not in found:
            found[module.path] = module
            work.extend(following(module))
    return list(found.values())


def _nearest(path: str, others: List[str]) -> List[str]:
    """Return those that share the most folders with a path."""
    here = PurePosixPath(path).parents
    shared = [len(set(here) & set(PurePosixPath(other).parents)) for other in others]
    return [other for other, count in zip(others, shared) if count == max(shared)]


def _order(definition: Definition) -> int:
    return definition.order


def _from(node: cst.ImportFrom) -> str:
    return "" if node.module is None else (dotted(node.module) or "")


def _unique(references: Iterable[Reference]) -> List[Reference]:
    found: Dict[Tuple[str, object], Reference] = {}
    for ref in references:
        key = (ref.kind, ref.target if isinstance(ref.target, str) else id(ref.target))
        found.setdefault(key, ref)
    return list(found.values())
