"""Read from a codebase's source which rasterizer it expects: modules, settings, names of results.

Forks of 3D Gaussian Splatting have their own rasterizers, under Inria's name or another, with more settings and more
results. The calls show which.
"""

from __future__ import annotations

import ast
import os
from pathlib import Path
from typing import Any, Dict, Iterator, List, NamedTuple, Optional, Sequence, Set, Tuple

from legs_adapters.code.folders import walk

__all__ = ["Interface", "InterfaceCall", "survey"]

RASTERIZER, SETTINGS = "GaussianRasterizer", "GaussianRasterizationSettings"


class InterfaceCall(NamedTuple):
    """One call of a rasterizer: its file, its first and last line, and the names that its result is unpacked to."""

    path: str
    first: int
    last: int
    results: Optional[Tuple[str, ...]]


class Interface:
    """The interface that the code expects of one module.

    Attributes:
        fields: the settings' names, in the order of their first use.
        calls: where it draws.
    """

    def __init__(self) -> None:
        self.fields: List[str] = []
        self.calls: List[InterfaceCall] = []

    def is_like(self, fields: Sequence[str], results: int) -> bool:
        """Return whether the code uses these settings only, and unpacks this number of results at each call."""
        known = all(field in fields for field in self.fields)
        return known and all(call.results is None or len(call.results) == results for call in self.calls)

    def results_at(self, path: str, line: int) -> Optional[Tuple[str, ...]]:
        """Return the names that the result is unpacked to at this place, or None where it is not."""
        for call in self.calls:
            if call.path == path and call.first <= line <= call.last:
                return call.results
        return None


def survey(root: Path) -> Dict[str, Interface]:
    """Return by module name the interfaces of ``GaussianRasterizer`` that code in ``root`` expects."""
    found: Dict[str, Interface] = {}
    for name in walk(root):
        path = root / name
        try:
            text = path.read_text(encoding="utf-8", errors="replace")
            if RASTERIZER not in text:
                continue
            tree = ast.parse(text)
        except (OSError, SyntaxError, ValueError):
            continue
        _read(tree, os.path.realpath(str(path)), found)
    return {name: interface for name, interface in found.items() if not _is_of(root, name)}


def _is_of(root: Path, module: str) -> bool:
    """Return whether a module is the codebase's own Python, which needs no shim."""
    place = root.joinpath(*module.split("."))
    file = place.with_suffix(".py") if place.with_suffix(".py").is_file() else place / "__init__.py"
    try:
        return "_C" not in file.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return module.startswith(".")


def _read(tree: ast.Module, path: str, found: Dict[str, Interface]) -> None:
    rasterizers: Dict[str, str] = {}  # what a file calls the class or its module's attribute: which module it is of
    settings: Dict[str, str] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and not node.level:
            for alias in node.names:
                if alias.name == RASTERIZER:
                    rasterizers[alias.asname or alias.name] = node.module
                    found.setdefault(node.module, Interface())
                elif alias.name == SETTINGS:
                    settings[alias.asname or alias.name] = node.module
    if not rasterizers:
        return
    objects: Dict[str, str] = {}  # what holds a rasterizer: which module's
    for node in ast.walk(tree):
        module = _called(node, settings)
        if module is not None and module in found:
            assert isinstance(node, ast.Call)
            fields = found[module].fields
            fields += [word.arg for word in node.keywords if word.arg and word.arg not in fields]
        if isinstance(node, ast.Assign):
            module = _called(node.value, rasterizers)
            if module is not None:
                objects.update({ast.dump(target).replace("Store()", "Load()"): module for target in node.targets})
    for node in ast.walk(tree):
        if not isinstance(node, (ast.Assign, ast.Return, ast.Expr)) or not isinstance(node.value, ast.Call):
            continue
        function = node.value.func
        module = objects.get(ast.dump(function)) or _called(function, rasterizers)
        if module is not None:
            target = node.targets[0] if isinstance(node, ast.Assign) else None
            lines = [child.lineno for child in _children(node)]
            found[module].calls.append(InterfaceCall(path, min(lines), max(lines), _names(target)))


def _called(node: Any, names: Dict[str, str]) -> Optional[str]:
    """Return the module of a callee, if it is among ``names``."""
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        return names.get(node.func.id)
    return None


def _children(node: ast.AST) -> Iterator[Any]:
    seen: Set[int] = set()
    for child in ast.walk(node):
        if hasattr(child, "lineno") and id(child) not in seen:
            seen.add(id(child))
            yield child


def _names(target: Optional[ast.AST]) -> Optional[Tuple[str, ...]]:
    if not isinstance(target, (ast.Tuple, ast.List)) or any(isinstance(part, ast.Starred) for part in target.elts):
        return None
    return tuple(_name(part) for part in target.elts)


def _name(part: ast.AST) -> str:
    if isinstance(part, ast.Name):
        return part.id
    if isinstance(part, ast.Attribute):
        return part.attr
    if isinstance(part, ast.Subscript):
        index: Any = part.slice
        index = getattr(index, "value", index)  # before Python 3.9 an index is wrapped
        return str(getattr(index, "value", getattr(index, "s", "_")) if isinstance(index, ast.AST) else index)
    return "_"
