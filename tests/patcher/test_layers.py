"""The layers of the patcher import in one direction only, and stay small enough to be read at a glance."""

from __future__ import annotations

import ast
from pathlib import Path

import legs_adapters
import pytest

ROOT = Path(legs_adapters.__file__).parent
LAYERS = ["code", "tensors", "lexicon", "terms", "upstreams", "rules"]
FILES = [path for layer in LAYERS for path in sorted((ROOT / layer).rglob("*.py"))]


def imported(path):
    """Return the modules that a file imports, wherever in it."""
    nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    names = [node.module or "" for node in nodes if isinstance(node, ast.ImportFrom) and not node.level]
    return names + [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]


@pytest.mark.parametrize("path", FILES, ids=lambda path: f"{path.parent.name}/{path.name}")
def test_a_layer_imports_only_those_before_it(path):
    below = LAYERS[: LAYERS.index(path.relative_to(ROOT).parts[0]) + 1]
    own = [name.split(".") for name in imported(path) if name.startswith("legs_adapters")]
    assert {parts[1] if len(parts) > 1 else "legs_adapters" for parts in own} <= set(below)


@pytest.mark.parametrize("path", FILES, ids=lambda path: f"{path.parent.name}/{path.name}")
def test_a_module_has_at_most_400_lines(path):
    assert len(path.read_text(encoding="utf-8").splitlines()) <= 400


@pytest.mark.parametrize("folder", sorted({path.parent for path in FILES}), ids=lambda folder: folder.name)
def test_a_folder_has_about_a_dozen_modules(folder):
    assert len([path for path in FILES if path.parent == folder and path.name != "__init__.py"]) <= 13


def test_the_reading_of_python_imports_neither_torch_nor_the_loss():
    names = {name.split(".")[0] for path in FILES if path.parent.name in ("code", "tensors") for name in imported(path)}
    assert not names & {"torch", "numpy"}
