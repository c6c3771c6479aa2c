"""Turn sites into edits of spans of text. Text outside of the spans is not changed, not even a space.

    Ll1 = l1_loss(image, gt_image)
    Ll1 = legs_loss.l1_loss(image, gt_image)

    loss += photometric(image, other_image.detach(), opt)
    loss += legs_loss.unweighted(photometric)(image, other_image.detach(), opt)

An edit never changes the number of lines of the expression it replaces: comments and line breaks inside are kept.
"""

from __future__ import annotations

import ast
import re
import warnings
from typing import List, Optional, Sequence, Tuple

import libcst as cst

from legs_adapters.code.module import Module
from legs_adapters.code.sources import Source
from legs_adapters.code.syntax import dotted
from legs_adapters.terms.findings import Kept, Site
from legs_adapters.terms.text import Edit, Text, on_one_line
from legs_adapters.terms.writing import PACKAGE, Writing
from legs_loss import LegsError

__all__ = ["PACKAGE", "Edit", "apply_edits", "rewrite"]


def apply_edits(data: bytes, edits: Sequence[Edit]) -> bytes:
    """Return the file's bytes with the edits made."""
    parts, at = [], 0
    for edit in sorted(edits):
        assert edit.start >= at and data[edit.start : edit.end] == edit.before
        parts += [data[at : edit.start], edit.after]
        at = edit.end
    return b"".join([*parts, data[at:]])


def rewrite(
    source: Source, module: Module, sites: Sequence[Site], kept: Sequence[Kept] = (), in_place: bool = False
) -> List[Edit]:
    """Return the edits that give one file the LEGS loss.

    Args:
        source, module: the file, and its parsed form.
        sites: its sites.
        kept: its calls that are not weighted.
        in_place: put the import on an existing line, so that every line keeps its number.

    Raises:
        LegsError: an edit would not parse (a bug of legs-patch; nothing is written then).
    """
    name, imported = _package_name(module)
    edits = [edit for site in sites for edit in _site_edits(Text(source, site.scope), site, name, in_place)]
    edits += [edit for call in kept for edit in _kept_edits(Text(source, call.scope), call, name)]
    if (sites or kept) and not imported:
        edits.append(_Import(Text(source, module.top)).edit(name, in_place))
    edits.sort()
    if not _parses(apply_edits(source.data, edits).decode("utf-8-sig")):
        raise LegsError(f"{source.path}: the rewritten file would not parse; please report this")
    return edits


def _parses(text: str) -> bool:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            ast.parse(text)
    except (SyntaxError, ValueError, RecursionError, MemoryError):  # newer than this Python, perhaps
        try:
            cst.parse_module(text)
        except cst.ParserSyntaxError:
            return False
    return True


def _site_edits(text: Text, site: Site, package: str, in_place: bool) -> List[Edit]:
    """Return the edits of one site."""
    form = site.form.moved(on_one_line(site.form.selection))
    where = f"{site.path}:{site.line}"
    writing = Writing(package, site.swapped, on_one_line(site.selection), where, in_place)
    return form.edits(text, writing)


def _kept_edits(text: Text, kept: Kept, package: str) -> List[Edit]:
    """Return the edits of one call that is not weighted."""
    start, end = text.span(kept.call.func, True)
    return [text.replace(start, start, f"{package}.unweighted("), text.replace(end, end, ")")]


class _Import:
    """The import of the package in one file, and its place."""

    def __init__(self, text: Text) -> None:
        self.text = text
        self.body = text.module.outline.tree.body

    def edit(self, name: str, in_place: bool) -> Edit:
        """Return the edit that imports the package under a name; ``in_place``: on an existing line."""
        line = f"import {PACKAGE}" + ("" if name == PACKAGE else f" as {name}")
        anchor = self._anchor()
        if anchor is None:
            at = self._before_first()
            if in_place and self.body and isinstance(self.body[0], cst.SimpleStatementLine):
                return self.text.replace(at, at, f"{line}; ")
            return self.text.replace(at, at, line + self._newline())
        first, last = anchor.body[0], anchor.body[-1]
        if in_place:
            if isinstance(first, (cst.Import, cst.ImportFrom)) and not _is_future(first):
                at = self.text.span(first)[0]
                return self.text.replace(at, at, f"{line}; ")
            at = self.text.span(last)[1]
            return self.text.replace(at, at, f"; {line}")
        at, newline = self._next_line(self.text.module.top.place(anchor).last_line)
        if newline:
            return self.text.replace(at, at, line + newline)
        return self.text.replace(at, at, self._newline() + line)  # the last line of a file that does not end in one

    def _anchor(self) -> Optional[cst.SimpleStatementLine]:
        """Return the statement that the import goes after: the last ``import torch...`` at the top, or the last one."""
        imports: List[cst.SimpleStatementLine] = []
        torch: List[cst.SimpleStatementLine] = []
        header: Optional[cst.SimpleStatementLine] = None
        for i, statement in enumerate(self.body):
            if not isinstance(statement, cst.SimpleStatementLine):
                if imports and not isinstance(statement, (cst.If, cst.Try, cst.With)):
                    break
                continue
            first = statement.body[0]
            if isinstance(first, (cst.Import, cst.ImportFrom)):
                if _is_future(first):
                    header = statement
                    continue
                imports.append(statement)
                if any(root == "torch" for root in _roots(first)):
                    torch.append(statement)
            elif (
                i == 0
                and isinstance(first, cst.Expr)
                and isinstance(first.value, (cst.SimpleString, cst.ConcatenatedString))
            ):
                header = statement
        if torch:
            return torch[-1]
        return imports[-1] if imports else header

    def _before_first(self) -> int:
        if not self.body:
            return len(self.text.bytes)
        first = (self.body[0], *getattr(self.body[0], "decorators", ()))
        return self.text.module.lines.start(min(self.text.module.top.place(node).line for node in first))

    def _newline(self) -> str:
        return self.text.module.outline.tree.default_newline

    def _next_line(self, line: int) -> Tuple[int, str]:
        """Return where the next line begins, and the line end before it; nothing for the last line."""
        at = self.text.module.lines.start(line + 1)
        ending = re.search(rb"(\r\n|\r|\n)?\Z", self.text.bytes[:at])
        assert ending is not None
        return at, ending.group().decode()


def _package_name(module: Module) -> Tuple[str, bool]:
    """Return the name that legs_loss has, or will have, in a file; and whether the file imports it already."""
    imported = False
    for function in module.scopes(lambda text: PACKAGE in text):
        for definition in function.flow.definitions.get(PACKAGE, []):
            alias = definition.node
            if isinstance(alias, cst.ImportAlias) and dotted(alias.name) == PACKAGE and alias.asname is None:
                imported = imported or function is module.top
            else:
                return f"{PACKAGE}_", False  # the name is taken, by a variable say
    return PACKAGE, imported


def _is_future(node: cst.CSTNode) -> bool:
    return isinstance(node, cst.ImportFrom) and node.module is not None and dotted(node.module) == "__future__"


def _roots(node: cst.Import | cst.ImportFrom) -> List[str]:
    if isinstance(node, cst.ImportFrom):
        return [] if node.relative or node.module is None else [(dotted(node.module) or "").split(".")[0]]
    return [(dotted(alias.name) or "").split(".")[0] for alias in node.names]
