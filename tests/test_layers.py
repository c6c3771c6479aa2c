"""The two packages meet at public names: read from their imports, wherever in a file these stand."""

from __future__ import annotations

import ast
import importlib
from pathlib import Path
from typing import Iterator, List, Tuple

import pytest

from legs_loss.plugins import plugins
from tests.support import ROOT

CORE, ADAPTERS = ROOT / "legs_loss", ROOT / "adapters" / "legs_adapters"


def imports(path: Path) -> Iterator[Tuple[int, str, str]]:
    """Line, module and name of each import; the name is empty for ``import module``."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name, "") for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{path}:{node.lineno}: a relative import"
            yield from ((node.lineno, str(node.module), alias.name) for alias in node.names)


def from_package(folder: Path, package: str) -> List[Tuple[str, str, str]]:
    """Place, module and name of what the files in a folder import from a package."""
    return [
        (f"{path.relative_to(ROOT)}:{line}", module, name)
        for path in sorted(folder.rglob("*.py"))
        for line, module, name in imports(path)
        if module.split(".")[0] == package
    ]


def is_public(module: str, name: str) -> bool:
    """Whether a name is published: in ``__all__`` of legs_loss, of a module in it, or of a folder below."""
    found = importlib.import_module(module)
    home = module.count(".") < 2 or hasattr(found, "__path__")
    return home and (not name or name in found.__all__)


def test_the_adapters_import_only_the_core_s_public_names() -> None:
    pytest.importorskip("numba")
    used = from_package(ADAPTERS, "legs_loss")
    assert [line for line in used if not is_public(*line[1:])] == []
    assert len(used) > 20  # the folder was found


def test_the_core_imports_nothing_of_the_adapters() -> None:
    assert from_package(CORE, "legs_adapters") == []
    assert len(from_package(CORE, "legs_loss")) > 100  # the folder was found


def test_what_the_adapters_add_is_found_by_entry_points() -> None:
    again = "the installed metadata is older than the checkout: pip install -e ."
    assert "run" in plugins("legs_loss.commands"), again
    assert {"gsplat", "nerfstudio"} <= set(plugins("legs_loss.upstreams")), again


def test_a_private_name_is_told_from_a_public_one() -> None:
    assert is_public("legs_loss", "l1_loss") and is_public("legs_loss.reference.rasterizer", "draw")
    assert not is_public("legs_loss.runtime", "_Run")
    assert not is_public("legs_loss.reference.rasterizer.sorting", "OWNER")
