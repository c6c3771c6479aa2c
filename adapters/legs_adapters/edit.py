"""The edit: sites in, spans of text out. What is not between a span's ends is not touched, not even a space.

    Ll1 = l1_loss(image, gt_image)
    Ll1 = legs_loss.l1_loss(image, gt_image, view=viewpoint_cam.image_name)

    loss += photometric(image, other_image.detach(), opt)
    loss += legs_loss.unweighted(photometric)(image, other_image.detach(), opt)

An edit never changes the number of lines of the expression it replaces: comments and line breaks inside are kept.
"""

from __future__ import annotations

import ast
import re
import warnings
from typing import List, NamedTuple, Optional, Sequence, Tuple

import libcst as cst

from legs_adapters.code.module import Function, Module
from legs_adapters.code.sources import Source, decode
from legs_adapters.code.syntax import code, dotted
from legs_adapters.terms.findings import Kept, Site
from legs_loss import LegsError

__all__ = ["PACKAGE", "Edit", "apply_edits", "rewrite"]


PACKAGE = "legs_loss"

_STRING = r"""("(?:\\.|[^"\\\r\n])*"|'(?:\\.|[^'\\\r\n])*')"""  # no comment begins inside
_GAP = re.compile(_STRING + r"|(?:\s|\\(?=[\r\n])|#[^\r\n]*)+")
_KEPT = re.compile(_STRING + r"|([ \t]*#[^\r\n]*|\\?(?:\r\n|\r|\n)[ \t]*)")


class Edit(NamedTuple):
    """Bytes from ``start`` to ``end`` of a file (its byte order mark counted) become ``after``."""

    start: int
    end: int
    before: bytes
    after: bytes


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
        kept: its calls that stay unweighted.
        in_place: put the import on a line that is there, so that every line keeps its number.

    Raises:
        LegsError: an edit would not parse (a fault of this tool; nothing is written then).
    """
    name, imported = _package_name(module)
    edits = [edit for site in sites for edit in _Text(source, site.scope).edits_for(site, name)]
    edits += [edit for call in kept for edit in _Text(source, call.scope).edits_around(call, name)]
    if (sites or kept) and not imported:
        edits.append(_Text(source, module.top).import_edit(name, in_place))
    edits.sort()
    checked = decode(source.path, apply_edits(source.data, edits))
    if not isinstance(checked, Source) or not _parses(checked.text):
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


class _Text:
    """A file's bytes, and where the nodes of one function stand in them."""

    def __init__(self, source: Source, function: Function) -> None:
        self.source = source
        self.function = function
        self.module = function.module
        self.bytes = self.module.lines.data
        self.body = self.module.outline.tree.body
        self.shift = len(source.bom)

    def span(self, node: cst.CSTNode, brackets: bool = False) -> Tuple[int, int]:
        """Where a node begins and ends, on request with the brackets around it."""
        place = self.function.place(node, brackets)
        return place.start, place.end

    def text(self, start: int, end: int) -> str:
        return self.bytes[start:end].decode("utf-8")

    def edit(self, start: int, end: int, after: str) -> Edit:
        start, end = start + self.shift, end + self.shift
        return Edit(start, end, self.source.data[start:end], after.encode("utf-8"))

    # -- one call that stays unweighted

    def edits_around(self, kept: Kept, name: str) -> List[Edit]:
        start, end = self.span(kept.call.func, True)
        return [self.edit(start, start, f"{name}.unweighted("), self.edit(end, end, ")")]

    # -- one site

    def edits_for(self, site: Site, name: str) -> List[Edit]:
        plain = _one_line(self.text(*self.span(site.form.node, True)))
        form = site.form._replace(selection=_one_line(site.form.selection))
        site = site._replace(form=form, selection=_one_line(site.selection))
        return [*self._edits_for(site, name), *(self.edit(*self.span(read, True), plain) for read in site.aside)]

    def _edits_for(self, site: Site, name: str) -> List[Edit]:
        form = site.form
        if form.reduction == "registered":
            assert form.callee is not None
            own = f"lambda input, target: {name}.l1_loss(input, target, own={code(form.callee)})"
            return [self.edit(*self.span(form.node, True), own)]
        if form.reduction == "callable":
            return [self.edit(*self.span(form.node, True), f"{name}.l1_loss")]
        if form.reduction == "again":
            first, second = (form.second, form.first) if site.swapped else (form.first, form.second)
            texts = [_one_line(self._argument(node, _carried(site))) for node in (first, second)]
            call = f"{name}.l1_loss({texts[0]}, {texts[1]}{self._settings(site, name, 'none', '')}){site.selection}"
            return [self.edit(*self.span(form.node, True), call)]
        if not form.direct:
            return self._named(site, name)
        if form.reduction == "wrapped":
            return self._wrapped(site, name)
        if form.callee is None:
            return self._absolute(site, name)
        return self._call(site, name)

    def _named(self, site: Site, name: str) -> List[Edit]:
        """``diff = a - b``, then ``diff[mask].abs().mean()``: the pictures are named in the difference's place."""
        form = site.form
        texts = [_one_line(self._argument(node, _carried(site))) for node in (form.first, form.second)]
        if site.swapped:
            texts.reverse()
        reduction = "none" if site.selection else form.reduction
        tail = site.selection + (".mean()" if site.selection and form.reduction == "mean" else "")
        residue = _residue(self.text(*self.span(form.node)))
        call = f"{name}.l1_loss({texts[0]}, {texts[1]}{self._settings(site, name, reduction, '')}{residue}){tail}"
        return [self.edit(*self.span(form.node), call)]

    def _settings(self, site: Site, name: str, reduction: str, own: str) -> str:
        parts = []
        if site.view.text is not None:
            parts.append(f"view={site.view.text}")
        if site.channels_last:
            parts.append("channels_last=True")
        if reduction == "none":
            parts.append('reduction="none"')
        if own:
            parts.append(f"own={own}")
        return "".join(f", {part}" for part in parts)

    def _call(self, site: Site, name: str) -> List[Edit]:
        form, call = site.form, site.form.call
        assert form.callee is not None
        taken = [arg for arg in call.args if arg.value is form.first or arg.value is form.second]
        extras = [arg for arg in call.args if arg not in taken]
        edits = [self.edit(*self.span(call.func, True), f"{name}.l1_loss")]
        texts = [self._argument(arg.value, site.selection) for arg in taken]
        if site.swapped:
            texts.reverse()
        order = ("prediction", "target")
        for i, (arg, text) in enumerate(zip(taken, texts)):
            keyword = f"{order[i]}=" if arg.keyword is not None else ""
            edits.append(self.edit(*self.span(arg), keyword + text))
        reduction, own, tail = form.reduction, "", ""
        if form.reduction == "own":
            own = self._own(site)
        elif site.selection:
            tail = site.selection + (".mean()" if form.reduction == "mean" else "")
            reduction = "none"
        after_taken = self.span(taken[-1])[1]
        drop = [arg for arg in extras]
        edits_end = after_taken
        residue = ""
        if drop:
            ends = [self.span(arg)[1] for arg in drop]
            starts = [self.span(arg)[0] for arg in drop]
            if min(starts) < after_taken:
                raise LegsError(
                    f"{site.path}:{site.line}: the images are not the first two arguments: "
                    f"write {name}.l1_loss(...) there by hand"
                )
            edits_end = max(ends)
            residue = _residue(self.text(after_taken, edits_end))
        settings = self._settings(site, name, reduction, own)
        if settings or residue or edits_end != after_taken:
            edits.append(self.edit(after_taken, edits_end, settings + residue))
        if tail:
            end = self.span(call)[1]
            edits.append(self.edit(end, end, tail))
        return edits

    def _argument(self, node: cst.BaseExpression, index: str) -> str:
        if index and isinstance(node, cst.Subscript):
            start, end = self.span(node.value, True)
            return self.text(start, end) + _residue(self.text(end, self.span(node)[1]))
        start, end = self.span(node, True)
        return self.text(start, end)

    def _own(self, site: Site) -> str:
        """The codebase's own function, with what else it is given."""
        form = site.form
        assert form.callee is not None
        callee = _one_line(code(form.callee))
        if not form.extras and not site.selection and not site.swapped:
            return callee
        extras = ", ".join(_flat(arg) for arg in form.extras)
        a, b = _names_for_two(f"{callee} {extras} {site.selection}")
        first, second = (f"{name}{site.selection}" for name in ((b, a) if site.swapped else (a, b)))
        return f"lambda {a}, {b}: {callee}({first}, {second}{', ' + extras if extras else ''})"

    def _absolute(self, site: Site, name: str) -> List[Edit]:
        """``torch.abs(a - b).mean()``: the words around the difference go, the difference becomes two arguments."""
        form = site.form
        difference = form.difference
        assert difference is not None
        start, end = self.span(form.node)
        left, right = self.span(difference.left, True), self.span(difference.right, True)
        texts = [self._argument(difference.left, site.selection), self._argument(difference.right, site.selection)]
        if site.swapped:
            texts.reverse()
        middle = _residue(self.text(left[1], right[0]))
        reduction = "none" if site.selection or form.reduction == "none" else "mean"
        tail = site.selection + (".mean()" if site.selection and form.reduction == "mean" else "")
        settings = self._settings(site, name, reduction, "")
        before = _residue(self.text(start, left[0]))
        after = _residue(self.text(right[1], end))
        return [
            self.edit(start, left[0], f"{name}.l1_loss({before}"),
            self.edit(left[0], left[1], texts[0]),
            self.edit(left[1], right[0], f",{middle}" if middle else ", "),
            self.edit(right[0], right[1], texts[1]),
            self.edit(right[1], end, f"{settings}{after}){tail}"),
        ]

    def _wrapped(self, site: Site, name: str) -> List[Edit]:
        """``torch.abs((a - b) * w)``: the expression stays, as a function of what is compared."""
        form = site.form
        difference = form.difference
        assert difference is not None
        start, end = self.span(form.node)
        left, right = self.span(difference.left, True), self.span(difference.right, True)
        pieces = [self.text(start, left[0]), self.text(left[1], right[0]), self.text(right[1], end)]
        index = site.selection  # into the pictures of own, for the weight is of whole ones
        a, b = _names_for_two(_one_line("\n".join([*pieces, index])))
        own = _one_line(f"lambda {a}, {b}: {pieces[0]}{a}{index}{pieces[1]}{b}{index}{pieces[2]}")
        texts = [self._argument(difference.left, index), self._argument(difference.right, index)]
        if site.swapped:
            texts.reverse()
            own = own.replace(f"lambda {a}, {b}:", f"lambda {b}, {a}:", 1)
        settings = self._settings(site, name, "", own)
        residue = _residue(self.text(start, left[0]) + self.text(left[1], right[0]) + self.text(right[1], end))
        return [self.edit(start, end, f"{name}.l1_loss({texts[0]}, {texts[1]}{settings}{residue})")]

    # -- the import

    def import_edit(self, name: str, in_place: bool) -> Edit:
        line = f"import {PACKAGE}" + ("" if name == PACKAGE else f" as {name}")
        anchor = self._anchor()
        if anchor is None:
            at = self._before_first()
            if in_place and self.body and isinstance(self.body[0], cst.SimpleStatementLine):
                return self.edit(at, at, f"{line}; ")
            return self.edit(at, at, line + self._newline())
        first, last = anchor.body[0], anchor.body[-1]
        if in_place:
            if isinstance(first, (cst.Import, cst.ImportFrom)) and not _is_future(first):
                at = self.span(first)[0]
                return self.edit(at, at, f"{line}; ")
            at = self.span(last)[1]
            return self.edit(at, at, f"; {line}")
        at, newline = self._next_line(self.module.top.place(anchor).last_line)
        if newline:
            return self.edit(at, at, line + newline)
        return self.edit(at, at, self._newline() + line)  # the last line of a file that does not end in one

    def _anchor(self) -> Optional[cst.SimpleStatementLine]:
        """The statement that the import goes after: the last ``import torch...`` at the top, or the last import."""
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
            return len(self.bytes)
        first = (self.body[0], *getattr(self.body[0], "decorators", ()))
        return self.module.lines.start(min(self.module.top.place(node).line for node in first))

    def _newline(self) -> str:
        return self.module.outline.tree.default_newline

    def _next_line(self, line: int) -> Tuple[int, str]:
        """Return where the line after this one begins, and what ends this one; nothing where it is the last."""
        at = self.module.lines.start(line + 1)
        ending = re.search(rb"(\r\n|\r|\n)?\Z", self.bytes[:at])
        assert ending is not None
        return at, ending.group().decode()


def _package_name(module: Module) -> Tuple[str, bool]:
    """The name that legs_loss has, or will have, in a file; and whether the file imports it already."""
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


def _names_for_two(text: str) -> Tuple[str, str]:
    """Two names for a lambda's parameters that a text does not use."""
    used = set(re.findall(r"\w+", text))
    pairs = [("a", "b"), ("prediction", "target"), ("prediction_", "target_")]
    return next((pair for pair in pairs if not used & set(pair)), ("_prediction", "_target"))


def _carried(site: Site) -> str:
    """The index that both sides of a difference carry, without the one that the difference itself is taken with."""
    return site.selection[: len(site.selection) - len(site.form.selection)]


def _flat(arg: cst.Arg) -> str:
    value = _one_line(code(arg.value))
    return f"{arg.keyword.value}={value}" if arg.keyword is not None else f"{arg.star}{value}"


def _one_line(text: str) -> str:
    """An expression on one line, without its comments."""
    return _GAP.sub(lambda gap: gap.group(1) or " ", text).strip()


def _residue(text: str) -> str:
    """What must stay of text that goes: its comments and its line breaks."""
    if "\n" not in text and "\r" not in text:
        return ""
    return "".join(kept for _, kept in _KEPT.findall(text))
