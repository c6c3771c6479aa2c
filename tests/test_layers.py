"""The two packages meet at public names: read from their imports, wherever in a file these stand."""

from __future__ import annotations

import ast
import importlib
from pathlib import Path
from typing import Iterator, List, Tuple

import pytest

from legs_loss.system import plugins
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
    """Return place, module and name of each import from a package in a folder's files."""
    return [
        (f"{path.relative_to(ROOT)}:{line}", module, name)
        for path in sorted(folder.rglob("*.py"))
        for line, module, name in imports(path)
        if module.split(".")[0] == package
    ]


def is_public(module: str, name: str) -> bool:
    """Return whether a name is published: in ``__all__`` of legs_loss, of a module in it, or of a folder below."""
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


# The core from the ground up. A module imports what stands before it, or beside it in the same line.
FLOORS = [
    {"_version", "errors"},
    {"system"},
    {"images", "operators", "curves", "upstreams"},
    {"spec", "scenes"},
    {"config", "responses"},
    {"levels", "similarity"},
    {"weights"},
    {"kernels"},
    {"store"},
    {"loss"},
    {"precompute", "runtime", "reference"},
    {"experiments"},
    {"report", "viewer"},
    {"cli"},
    {"__main__"},
]


@pytest.mark.parametrize("floor", range(len(FLOORS)), ids=lambda floor: "+".join(sorted(FLOORS[floor])))
def test_a_module_of_the_core_imports_only_those_before_it(floor: int) -> None:
    below = set().union(*FLOORS[:floor])
    for name in FLOORS[floor]:
        folder = CORE / name
        files = sorted(folder.rglob("*.py")) if folder.is_dir() else [CORE / f"{name}.py"]
        assert files
        for path in files:
            allowed = below | {name}
            used = {(f"{module}.{what}").split(".")[1] for _, module, what in imports(path) if is_own(module)}
            assert used <= allowed, path


def test_every_module_of_the_core_has_its_floor() -> None:
    names = {path.stem for path in CORE.iterdir() if path.suffix == ".py" or (path / "__init__.py").is_file()}
    assert names - {"__init__"} == set().union(*FLOORS)


@pytest.mark.parametrize("folder", sorted({path.parent for path in CORE.rglob("*.py")}), ids=lambda path: path.name)
def test_a_folder_of_the_core_has_about_a_dozen_modules(folder: Path) -> None:
    assert len([path for path in folder.glob("*.py") if not path.name.startswith("_")]) <= 13


def is_own(module: str) -> bool:
    """Return whether a module is one of the core."""
    return module.split(".")[0] == "legs_loss"
