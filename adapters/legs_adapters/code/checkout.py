"""The files of a checkout: parsed on first use, searched by name, linked by their imports."""

from __future__ import annotations

import ast
import re
from pathlib import PurePosixPath
from typing import Callable, Dict, Iterable, Iterator, List, Optional

from legs_adapters.code.limits import Budget, remembered
from legs_adapters.code.module import Class, Function, Module, index_by_word, parse
from legs_adapters.code.sources import Source, Unreadable


class Checkout:
    """The readable files of a checkout.

    Args:
        sources: the readable files.
        budget: what their analysis may take; default: a budget of its own.
    """

    def __init__(self, sources: Iterable[Source], budget: Optional[Budget] = None) -> None:
        self.sources: Dict[str, Source] = {source.path: source for source in sources}
        self.budget: Budget = budget or Budget()
        self.when_read: Callable[[str], object] = len  # given the path of each file that was parsed
        self._unreadable: Dict[str, Unreadable] = {}
        self._modules: Dict[str, Optional[Module]] = {}
        self._by_stem: Dict[str, List[str]] = {}
        for path in map(PurePosixPath, self.sources):
            stem = path.parent.name if path.name == "__init__.py" else path.stem
            self._by_stem.setdefault(stem, []).append(path.as_posix())
        self._by_word = index_by_word((path, source.text) for path, source in self.sources.items())

    def module(self, path: str) -> Optional[Module]:
        """Return a parsed file; None where it is none of these or does not parse (it is then among ``unreadable``)."""
        if path in self.sources and path not in self._modules:
            parsed = parse(self.sources[path], self.budget)
            self.when_read(path)
            if isinstance(parsed, Unreadable):
                self._unreadable[path] = parsed
            self._modules[path] = parsed if isinstance(parsed, Module) else None
        return self._modules.get(path)

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
        for path in self.paths_matching(pattern):
            module = self.module(path)
            if module is not None:
                yield module

    @remembered
    def paths_matching(self, pattern: re.Pattern[str]) -> List[str]:
        """Return the paths of the files whose text matches."""
        return [path for path, source in self.sources.items() if pattern.search(source.text)]

    @remembered
    def mentioning(self, name: str, called: bool = False) -> List[Function]:
        """Return the functions and top levels whose text mentions a name, or calls it."""
        modules = map(self.module, self._by_word.get(f"{name}(" if called else name, ()))
        return [function for module in modules if module for function in module.mentioning(name, called)]

    @remembered
    def methods_named(self, name: str) -> List[Function]:
        """Return every method of this name in the checkout."""
        defined = re.compile(rf"def[ \t]+{re.escape(name)}\b")
        paths = [path for path in self._by_word.get(name, ()) if defined.search(self.sources[path].text)]
        modules = filter(None, map(self.module, paths))
        owners = [each for module in modules for each in module.by_node.values() if isinstance(each, Class)]
        return [owner.methods[name] for owner in owners if name in owner.methods]

    # -- imports

    def imported_from(self, module: Module, node: ast.ImportFrom, member: str = "") -> Optional[Module]:
        """Return the checkout's module that a ``from ... import`` statement names."""
        return self.find_module(module, node.module or "", node.level, member)

    @remembered
    def find_module(self, module: Module, name: str, level: int, member: str = "") -> Optional[Module]:
        """Return the checkout's module of this name, resolved from another; None where it is not the checkout's.

        A script can add any folder to sys.path: a module of one word is only found there if it defines the member.
        """
        path = self._find_path(module.path, name.replace(".", "/"), level, member)
        return self.module(path) if path is not None else None

    def _find_path(self, path: str, inner: str, level: int, member: str) -> Optional[str]:
        above = list(PurePosixPath(path).parents)
        names = [inner]
        if not level and "__init__.py" in self.sources:  # the checkout is itself a package
            names.append(inner.partition("/")[2])
        for base in above[level - 1 : level] if level else [*above, PurePosixPath("src")]:
            for name in names:
                files = [base / f"{name}.py", base / name / "__init__.py"] if name or level else []
                for file in files:
                    if file.as_posix() in self.sources:
                        return file.as_posix()
        if level or not ("/" in inner or member):
            return None
        known = self._by_stem.get(PurePosixPath(inner).name, [])
        ends = [file for file in known if file.endswith((f"/{inner}.py", f"/{inner}/__init__.py"))]
        if "/" not in inner:
            defines = re.compile(rf"^(?:class|def)[ \t]+{member}\b", re.M)
            ends = [file for file in ends if defines.search(self.sources[file].text)]
        shared = [len(set(above) & set(PurePosixPath(file).parents)) for file in ends]
        nearest = [file for file, count in zip(ends, shared) if count == max(shared)]
        return nearest[0] if len(nearest) == 1 else None
