"""Find the packages that a training script imports and this Python lacks, before the script is run."""

from __future__ import annotations

import ast
import importlib.util
from pathlib import Path
from typing import Iterable, Iterator, List, Set

from legs_adapters.shims.finder import table_for
from legs_adapters.shims.inria.survey import survey
from legs_loss import LegsError

__all__ = ["check_imports", "missing"]

# Where a package is installed by another name than it is imported by.
DISTRIBUTIONS = {
    "PIL": "pillow",
    "cv2": "opencv-python",
    "skimage": "scikit-image",
    "sklearn": "scikit-learn",
    "yaml": "pyyaml",
}


def check_imports(root: Path, script: str) -> None:
    """Check that `legs run --cpu` can import all that a script of the checkout in ``root`` imports.

    Raises:
        LegsError: it cannot; the message names the packages, and the command that installs them.
    """
    shims = {name.split(".")[0] for name in table_for(survey(root))}
    lacking = missing(root / script, shims, root)
    if lacking:
        names = " ".join(DISTRIBUTIONS.get(name, name) for name in lacking)
        raise LegsError(f"{script} imports {', '.join(lacking)}, not installed here: pip install {names}")


def missing(script: Path, built: Iterable[str] = (), root: Path | None = None) -> List[str]:
    """Return the packages that a script needs, by itself or by modules beside it, and that are not installed.

    An import in a ``try`` is none that it needs, nor one within a function.

    Args:
        script: of a codebase whose own modules lie in the script's folder.
        built: packages that are there in another way.
        root: of the codebase, if its modules lie elsewhere in it, too: the script may change its path.
    """
    known = set(built) | (_own_modules(root) if root is not None else set())
    lacking: Set[str] = set()
    seen, files = {script}, [script]
    while files:
        for name in _imported(files.pop()):
            top = name.split(".")[0]
            new = {path for path in _local(script.parent, name) if path.is_file()} - seen
            seen |= new
            files += sorted(new)
            is_local = (script.parent / top).is_dir() or (script.parent / f"{top}.py").is_file()
            if not is_local and top not in known and importlib.util.find_spec(top) is None:
                lacking.add(top)
    return sorted(lacking)


def _own_modules(root: Path) -> Set[str]:
    """Return the names of all folders and files of Python in a checkout, its submodules too."""
    paths = [path.relative_to(root) for path in root.rglob("*.py")]
    return {part for path in paths for part in path.with_suffix("").parts}


def _imported(file: Path) -> Iterator[str]:
    """Yield the names of modules that a file imports whenever it is loaded: "a.b", and of "from a import b" "a.b"."""
    try:
        tree = ast.parse(file.read_text(encoding="utf-8", errors="replace"))
    except (SyntaxError, ValueError):
        return
    for statement in tree.body:
        if isinstance(statement, ast.Import):
            yield from (alias.name for alias in statement.names)
        elif isinstance(statement, ast.ImportFrom) and statement.level == 0:
            yield str(statement.module)
            yield from (f"{statement.module}.{alias.name}" for alias in statement.names)


def _local(folder: Path, name: str) -> List[Path]:
    """Return the files that a module of the codebase's own may be: itself, and the packages that it lies in."""
    parts = name.split(".")
    packages = [folder.joinpath(*parts[:i], "__init__.py") for i in range(1, len(parts) + 1)]
    return [*packages, folder.joinpath(*parts[:-1], f"{parts[-1]}.py")]
