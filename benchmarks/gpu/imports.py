"""Find the packages that a training script imports and this Python lacks, before its modules are built."""

from __future__ import annotations

import ast
import importlib.util
from pathlib import Path
from typing import Iterable, Iterator, List, Sequence, Set

from benchmarks.gpu.options import Skipped

__all__ = ["missing", "need"]

OURS = ("libcst",)  # what `legs run` itself needs


def need(scripts: Sequence[Path], built: Iterable[str] = ()) -> None:
    """Check that `legs run` can run a codebase's scripts; arguments as for :func:`missing`.

    Raises:
        Skipped: they cannot; the message names the packages.
    """
    lacking = sorted({name for script in scripts for name in missing(script, built)})
    lacking += [name for name in OURS if importlib.util.find_spec(name) is None]
    if lacking:
        raise Skipped(f"{scripts[0].name} needs what is not installed: {', '.join(lacking)}")


def missing(script: Path, built: Iterable[str] = ()) -> List[str]:
    """Return the packages that a script needs, by itself or by modules beside it, and that are not installed.

    An import in a ``try`` is none that it needs, nor one within a function.

    Args:
        script: of a codebase whose own modules lie in the script's folder.
        built: packages that are yet to be built.
    """
    root, known = script.parent, set(built)
    lacking: Set[str] = set()
    seen, files = {script}, [script]
    while files:
        for name in _imported(files.pop()):
            top = name.split(".")[0]
            new = {path for path in _local(root, name) if path.is_file()} - seen
            seen |= new
            files += sorted(new)
            own = (root / top).is_dir() or (root / f"{top}.py").is_file()
            if not own and top not in known and importlib.util.find_spec(top) is None:
                lacking.add(top)
    return sorted(lacking)


def _imported(file: Path) -> Iterator[str]:
    """Yield the names of modules that a file imports whenever it is loaded: "a.b", and of "from a import b" "a.b"."""
    tree = ast.parse(file.read_text(encoding="utf-8", errors="replace"))
    for statement in tree.body:
        if isinstance(statement, ast.Import):
            yield from (alias.name for alias in statement.names)
        elif isinstance(statement, ast.ImportFrom) and statement.level == 0:
            yield str(statement.module)
            yield from (f"{statement.module}.{alias.name}" for alias in statement.names)


def _local(root: Path, name: str) -> List[Path]:
    """Return the files that a module of the codebase's own may be: itself, and the packages that it lies in."""
    parts = name.split(".")
    packages = [root.joinpath(*parts[:i], "__init__.py") for i in range(1, len(parts) + 1)]
    return [*packages, root.joinpath(*parts[:-1], f"{parts[-1]}.py")]
