"""The files of a checkout: parsed on first use, searched by name, linked by their imports."""

from __future__ import annotations

import re
from pathlib import PurePosixPath
from typing import Callable, Dict, Iterable, Iterator, List, Mapping, Optional, Set, Tuple

import libcst as cst

from legs_adapters.code.limits import Budget
from legs_adapters.code.module import Function, Module, parse, said
from legs_adapters.code.sources import Source, Unreadable
from legs_adapters.code.syntax import dotted

__all__ = ["Checkout", "imported_name"]

_DEFINED = re.compile(r"^[ \t]*(?:async[ \t]+)?(?:def|class)[ \t]+(\w+)", re.M)


class Checkout:
    """The readable files of a checkout.

    Args:
        sources: the readable files.
        unread: by path, the text of ignored and unreadable files, which is only searched for names.
    """

    def __init__(self, sources: Iterable[Source], unread: Optional[Mapping[str, str]] = None) -> None:
        self.unread: Mapping[str, str] = unread or {}
        self.sources: Dict[str, Source] = {source.path: source for source in sources}
        self._budget = Budget()
        self._unreadable: Dict[str, Unreadable] = {}
        self._modules: Dict[str, Optional[Module]] = {}
        self._mentions: Dict[Tuple[str, bool], List[Function]] = {}
        self._methods: Dict[str, List[Function]] = {}
        self._by_word: Optional[Dict[str, List[str]]] = None  # as ``said`` has them
        self._defined: Dict[str, List[str]] = {}
        self._by_import: Dict[Tuple[str, str, int], Optional[Module]] = {}
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
            parsed = parse(self.sources[path], self._budget)
            if isinstance(parsed, Unreadable):
                self._unreadable[path] = parsed
            self._modules[path] = parsed if isinstance(parsed, Module) else None
        return self._modules[path]

    @property
    def unreadable(self) -> Dict[str, Unreadable]:
        """Files that do not parse, by path, each with the reason."""
        failed = {m.path: m.failure for m in self._modules.values() if m is not None and m.failure is not None}
        return {**self._unreadable, **failed}

    def give_up(self, path: str, reason: str) -> None:
        """Record a file as unreadable."""
        self._unreadable[path] = Unreadable(path, reason)

    def matching(self, pattern: re.Pattern[str]) -> Iterator[Module]:
        """Yield the modules whose text matches, each parsed when it is reached."""
        for path, source in self.sources.items():
            module = self.module(path) if pattern.search(source.text) else None
            if module is not None:
                yield module

    def mentioning(self, name: str, called: bool = False) -> List[Function]:
        """Return the functions and top levels whose text mentions a name, or calls it."""
        if self._by_word is None:
            self._by_word = {}
            for path, source in self.sources.items():
                for word in said(source.text):
                    self._by_word.setdefault(word, []).append(path)
        if (name, called) not in self._mentions:
            modules = [self.module(path) for path in self._by_word.get(f"{name}(" if called else name, ())]
            self._mentions[name, called] = [
                function for module in modules if module is not None for function in module.mentioning(name, called)
            ]
        return self._mentions[name, called]

    def methods_named(self, name: str) -> List[Function]:
        """Return every method of this name in the checkout."""
        if name not in self._methods:
            modules = [self.module(path) for path in self._defined.get(name, [])]
            self._methods[name] = [
                function
                for module in modules
                if module is not None
                for function in module.named(name)
                if function.owner is not None
            ]
        return self._methods[name]

    # -- imports

    def imported_from(self, module: Module, node: cst.ImportFrom) -> Optional[Module]:
        """Return the checkout's module that a ``from ... import`` statement names."""
        return self.find_module(module, imported_name(node), len(node.relative))

    def together(self, module: Module) -> Set[str]:
        """Return the paths of the files that run together with another: all imports of the files that import it.

        Imports inside of functions, and modules that are loaded by name, are not found.
        """
        if module.path not in self._together:
            users = _closure([module], self._users)
            self._together[module.path] = {found.path for found in _closure(users, self._imports)}
        return self._together[module.path]

    def _users(self, module: Module) -> List[Module]:
        """Return the modules that import another."""
        path = PurePosixPath(module.path)
        name = path.parent.name if path.name == "__init__.py" else path.stem
        return [other for other in self.matching(re.compile(rf"\b{name}\b")) if module in self._imports(other)]

    def _imports(self, module: Module) -> List[Module]:
        """Return the checkout's modules that a module imports."""
        found: List[Optional[Module]] = []
        for node in module.top.flow.imports:
            assert isinstance(node, (cst.Import, cst.ImportFrom))
            names = [] if isinstance(node.names, cst.ImportStar) else [dotted(alias.name) or "" for alias in node.names]
            if isinstance(node, cst.ImportFrom):
                stem, level = imported_name(node), len(node.relative)
                base = self.imported_from(module, node)
                found.append(base)
                if base is None and stem and not level:
                    found.extend(self._on_path(module, stem, name) for name in names)
                found.extend(self.find_module(module, f"{stem}.{name}" if stem else name, level) for name in names)
            else:
                found.extend(self.find_module(module, name, 0) for name in names)
        return [other for other in found if other is not None]

    def find_module(self, module: Module, name: str, level: int) -> Optional[Module]:
        """Return the checkout's module of this name, resolved from another; None where it is not the checkout's."""
        asked = (module.path, name, level)
        if asked not in self._by_import:
            self._by_import[asked] = self._find_module(module, name, level)
        return self._by_import[asked]

    def _find_module(self, module: Module, name: str, level: int) -> Optional[Module]:
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
        # Scripts extend sys.path: use the only file whose path ends so, or the nearest one.
        known = self._ending.get(inner.rpartition("/")[2], []) if "/" in inner else []
        ends = _nearest(module.path, [p for p in known if p.endswith((f"/{inner}.py", f"/{inner}/__init__.py"))])
        return self.module(ends[0]) if len(ends) == 1 else None

    def _on_path(self, module: Module, stem: str, name: str) -> Optional[Module]:
        """Find the nearest ``base.py`` that defines a Trainer, for ``from base import Trainer``.

        A script can add its folder to sys.path. In a checkout that is itself a package, the import may also be
        ``from its_name.base import Trainer``.
        """
        defines = re.compile(rf"^(?:class|def)[ \t]+{re.escape(name)}\b", re.M)
        own = stem.partition(".")[2].replace(".", "/") + ".py" if "__init__.py" in self.sources else ""
        known = [own] if own in self.sources else self._ending.get(stem, [])
        ends = [p for p in known if defines.search(self.sources[p].text)]
        ends = _nearest(module.path, ends)
        return self.module(ends[0]) if len(ends) == 1 else None


def imported_name(node: cst.ImportFrom) -> str:
    """Return the dotted name after ``from``, without its leading dots."""
    return "" if node.module is None else (dotted(node.module) or "")


def _closure(modules: Iterable[Module], following: Callable[[Module], List[Module]]) -> List[Module]:
    """Return the modules and all that are reachable from them."""
    found: Dict[str, Module] = {}
    work = list(modules)
    while work:
        module = work.pop()
        if module.path not in found:
            found[module.path] = module
            work.extend(following(module))
    return list(found.values())


def _nearest(path: str, others: List[str]) -> List[str]:
    """Return the paths that share the most folders with a path."""
    here = PurePosixPath(path).parents
    shared = [len(set(here) & set(PurePosixPath(other).parents)) for other in others]
    return [other for other, count in zip(others, shared) if count == max(shared)]
