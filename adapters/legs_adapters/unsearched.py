"""Find what may be the loss where a plan does not look: in submodules, third-party code, files that are not read."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any, Dict, Iterator, List, NamedTuple, Sequence, Tuple

from legs_adapters.code.folders import LINK, PATCHABLE, SUBMODULE, VENDORED, WORKTREE, first_of, folders_of
from legs_adapters.code.limits import Budget
from legs_adapters.code.sources import Source, read_files
from legs_adapters.lexicon.words import SPLATS
from legs_adapters.rules.find import find
from legs_adapters.terms.findings import Findings, Line
from legs_loss import LegsError


class Unsearched(NamedTuple):
    """A codebase that is not searched, with the first line in it that may be the loss; relative to the root.

    Of a link, which is not followed, the folder and line 0.
    """

    folder: str
    why: str
    path: str
    line: int

    def text(self, root: object) -> str:
        """Return what to run there."""
        where = f"{self.path}:{self.line} may be the loss, and" if self.line else "there is code there, and"
        command = f"legs-patch {shlex.quote(f'{root}/{self.folder}')}"
        return f"{where} {self.folder} is not searched ({self.why}): {command}"


def unsearched(root: Path, budget: Budget, exclude: Sequence[str] = ()) -> Iterator[Unsearched]:
    """Yield the folders that are other codebases, draw Gaussians and have a term of their own; and links to code."""
    for folder, why in sorted(_skipped(root, "", exclude)):
        if why == LINK:
            yield Unsearched(folder, why, folder, 0)
            continue
        by_codebase: Dict[str, List[Source]] = {}
        try:
            sources = read_files(root / folder, exclude)[0]
        except LegsError:  # larger than a codebase
            continue
        for source in sources:
            inner = source.path.split("/")[0] if why == VENDORED and "/" in source.path else ""
            by_codebase.setdefault(f"{folder}/{inner}".rstrip("/"), []).append(source)
        for codebase, sources in by_codebase.items():
            if any(SPLATS.search(source.text) for source in sources):
                found = find(sources, budget=Budget(beside=budget))
                over = [Line(each.path, 1, "") for each in found.unreadable if budget.why_none_left()]
                hits: List[Any] = [*found.sites, *found.problems, *over]
                yield from (Unsearched(codebase, why, f"{folder}/{hit.path}", hit.line) for hit in hits[:1])


def _skipped(root: Path, below: str, exclude: Sequence[str]) -> Iterator[Tuple[str, str]]:
    """Yield the folders below one that are not searched, and those in them, each with the reason."""
    skipped = [folder for _, inner in folders_of(root / below, exclude) for folder in inner]
    for path, why in [each for each in skipped if each.why in (SUBMODULE, VENDORED, WORKTREE, LINK)]:
        path = f"{below}/{path}".lstrip("/")
        yield path, why
        yield from () if why == LINK else _skipped(root, path, exclude)


def unread(root: Path, exclude: Sequence[str], found: Findings) -> str:
    """Name the first of the files that could not be read, and of the folders that are skipped and may be codebases."""
    files = [f"{file.path}: {file.reason}" for file in found.unreadable]
    skipped = sorted(folder for _, inner in folders_of(root, exclude) for folder in inner if folder.why in PATCHABLE)
    folders = [f"{folder.path} ({folder.why})" for folder in skipped]
    said = f"; not read: {first_of(files, 1)}" if files else ""
    return said + (f"; not searched: {first_of(folders, 3)}: run legs-patch on the one that trains" if folders else "")
