"""The two packages meet at public names: read from their imports, wherever in a file these stand."""

from __future__ import annotations

import ast
import importlib
import subprocess
import sys
from pathlib import Path
from typing import Iterator, List, Set, Tuple

import pytest

from legs_loss.system.entry_points import plugins
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


def defined(path: Path) -> Set[str]:
    """Return the names that a module defines, or imports by ``as`` for others."""
    found: Set[str] = set()
    statements = ast.parse(path.read_text(encoding="utf-8")).body
    for node in statements:
        if isinstance(node, ast.If):
            statements += node.body
        elif isinstance(node, (ast.Import, ast.ImportFrom)):
            found |= {alias.asname for alias in node.names if alias.asname}
        elif isinstance(node, (ast.ClassDef, ast.FunctionDef)):
            found.add(node.name)
        elif isinstance(node, (ast.Assign, ast.AnnAssign)):
            found |= {one.id for one in ast.walk(node) if isinstance(one, ast.Name) and isinstance(one.ctx, ast.Store)}
    return found


def is_public(module: str, name: str) -> bool:
    """Return whether a name has no underscore and is of a module of legs_loss or of its system, or of a folder."""
    found = importlib.import_module(module)
    home = module.count(".") < 2 or hasattr(found, "__path__") or module.startswith("legs_loss.system.")
    return home and (
        not name or name == "__version__" or (name[0] != "_" and name in defined(Path(found.__file__ or "")))
    )


def test_the_adapters_import_only_the_core_s_public_names() -> None:
    pytest.importorskip("numba")
    used = from_package(ADAPTERS, "legs_loss")
    assert [line for line in used if not is_public(*line[1:])] == []
    lab = [place for place, module, name in used if f"{module}.{name}".startswith("legs_loss.lab")]
    # The latter two run a script on the shims.
    drawing = tuple(f"adapters/legs_adapters/{name}" for name in ("shims/", "verify.py", "trace/tracing.py"))
    assert lab and all(place.startswith(drawing) for place in lab)
    assert len(used) > 20  # the folder was found


def test_the_core_imports_nothing_of_the_adapters() -> None:
    assert from_package(CORE, "legs_adapters") == []
    assert len(from_package(CORE, "legs_loss")) > 100  # the folder was found


def test_what_the_lab_and_the_adapters_add_is_found_by_entry_points() -> None:
    again = "the installed metadata is older than the checkout: pip install -e ."
    assert {"run", "train"} <= set(plugins("legs_loss.commands")), again
    assert {"gsplat", "nerfstudio"} <= set(plugins("legs_loss.upstreams")), again


def test_a_private_name_is_told_from_a_public_one() -> None:
    assert is_public("legs_loss", "l1_loss") and is_public("legs_loss.lab.rasterizer", "draw")
    assert not is_public("legs_loss.runtime", "_Run")
    assert is_public("legs_loss.errors", "require") and not is_public("legs_loss.errors", "difflib")
    assert not is_public("legs_loss.spec", "_RANGES") and not is_public("legs_loss.spec", "curve")
    assert not is_public("legs_loss.lab.rasterizer.sorting", "OWNER")


# The core from the ground up, with the lab on its roof. A module imports what stands before it.
FLOORS = [
    {"_version", "errors"},
    {"system"},
    {"autograd", "counting"},
    {"images", "operators", "curves", "upstreams"},
    {"spec", "scenes"},
    {"config", "responses"},
    {"similarity"},
    {"weights"},
    {"kernels"},
    {"store"},
    {"loss"},
    {"precompute", "runtime"},
    {"cli"},
    {"lab", "__main__"},
]
LAB_FLOORS = [
    {"simd", "conventions", "reconstruct", "values"},
    {"gaussians"},
    {"ply", "rasterizer"},
    {"embedded", "surfels", "training"},
    {"experiments"},
    {"report", "viewer"},
    {"commands"},
]
HOUSES = {"legs_loss": FLOORS, "legs_loss.lab": LAB_FLOORS}


@pytest.mark.parametrize(
    ("package", "floor"), [(package, floor) for package, floors in HOUSES.items() for floor in range(len(floors))]
)
def test_a_module_imports_only_those_before_it(package: str, floor: int) -> None:
    below = set().union(*HOUSES[package][:floor])
    for name in HOUSES[package][floor]:
        folder = ROOT.joinpath(*package.split("."), name)
        files = sorted(folder.rglob("*.py")) if folder.is_dir() else [folder.with_suffix(".py")]
        assert files
        for path in files:
            named = [f"{module}.{what}" for _, module, what in imports(path)]
            own = {full[len(package) + 1 :].split(".")[0] for full in named if full.startswith(f"{package}.")}
            assert own <= below | {name}, path


@pytest.mark.parametrize("package", HOUSES)
def test_every_module_has_its_floor(package: str) -> None:
    files = ROOT.joinpath(*package.split(".")).iterdir()
    names = {path.stem for path in files if path.suffix == ".py" or (path / "__init__.py").is_file()}
    assert names - {"__init__"} == set().union(*HOUSES[package])


def test_a_training_script_loads_little_of_the_core() -> None:
    code = "import sys, legs_loss; legs_loss.l1_loss; print(*sys.modules)"
    modules = subprocess.run([sys.executable, "-c", code], stdout=subprocess.PIPE, check=True).stdout.decode().split()
    loaded = [name for name in modules if name.split(".")[0] == "legs_loss"]
    assert "legs_loss.runtime.l1" in loaded and len(loaded) <= 25
    assert not [name for name in loaded if name.split(".")[1:2] in (["lab"], ["scenes"], ["precompute"], ["cli"])]


@pytest.mark.parametrize("folder", sorted({path.parent for path in CORE.rglob("*.py")}), ids=lambda path: path.name)
def test_a_folder_of_the_core_has_about_a_dozen_modules(folder: Path) -> None:
    assert len([path for path in folder.glob("*.py") if not path.name.startswith("_")]) <= 13
