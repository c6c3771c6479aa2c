"""Turn sites into edits of spans of text. Text outside of the spans is not changed, not even a space.

    Ll1 = l1_loss(image, gt_image)
    Ll1 = legs_loss.l1_loss(image, gt_image)

    loss += photometric(image, other_image.detach(), opt)
    loss += legs_loss.unweighted(photometric)(image, other_image.detach(), opt)

An edit never changes the number of lines of the expression it replaces: comments and line breaks inside are kept.
"""

from __future__ import annotations

import ast
import itertools
import sys
from typing import List, Optional, Sequence

from legs_adapters.code.module import Module
from legs_adapters.code.parsing import read_by_python
from legs_adapters.code.syntax import FUNCTIONS, constant
from legs_adapters.terms.findings import Findings
from legs_adapters.terms.text import Edit, Text, apply_edits
from legs_adapters.terms.writing import PACKAGE
from legs_loss import LegsError


def rewrite(findings: Findings, path: str, in_place: bool = False) -> List[Edit]:
    """Return the edits that give one file the LEGS loss.

    Args:
        findings, path: what was found in the checkout, and the file.
        in_place: add no import, so that every line keeps its number: the file is run in memory, with the name built in.

    Raises:
        LegsError: the file has a legs_loss of its own; or the result would not compile (a bug of legs-patch).
        ValueError: this Python cannot compile the file, or one term is in another.
    """
    source, module = findings.program.sources[path], findings.program.module(path)
    assert module is not None
    is_imported = _is_imported(module)
    edits: List[Edit] = []
    for site in (each for each in findings.sites if each.path == path):
        edits += site.form.edits(Text(source, site.scope), site.writing(in_place))
    for use in (each for each, _ in findings.unweighted if each.caller.module.path == path):
        text = Text(source, use.caller)
        start, end = text.span(use.call.func)
        edits.append(text.replace(start, end, f"{PACKAGE}.unweighted({text.between(start, end)})"))
    if not (is_imported or in_place):
        edits.append(_import(Text(source, module.top)))
    edits.sort()
    why = why_not_compiled(apply_edits(source.data, edits))
    if why:
        before = why_not_compiled(source.data)
        raise ValueError(before) if before else LegsError(f"{path}: rewritten, {why}; please report this")
    return edits


def why_not_compiled(data: bytes) -> str:
    """Return why this Python cannot compile a file, or ""."""
    made = read_by_python(data, flags=0)
    version = ".".join(map(str, sys.version_info[:2]))
    return f"Python {version} cannot compile it: {made}" if isinstance(made, Exception) else ""


def _import(text: Text) -> Edit:
    """Return the edit that imports the package."""
    module, body = text.module, text.module.top.body
    line = f"import {PACKAGE}"
    newline = "\r\n" if b"\r\n" in text.bytes else "\n"
    anchor = _anchor(body)
    if anchor is None:
        first = [node for part in body[:1] for node in (part, *getattr(part, "decorator_list", ()))]
        lines = [module.top.place(node, True).line for node in first]
        at = module.lines.start(min(lines)) if lines else len(text.bytes)
        return text.replace(at, at, line + newline)
    at = len(text.bytes[: module.lines.start(module.top.place(anchor).last_line + 1)].rstrip(b"\r\n"))
    return text.replace(at, at, newline + line)


def _anchor(body: Sequence[ast.stmt]) -> Optional[ast.AST]:
    """Return the statement that the import goes after: the last import above functions and classes, or a docstring."""
    top = itertools.takewhile(lambda each: not isinstance(each, (*FUNCTIONS, ast.ClassDef)), body)
    imports = [each for each in top if isinstance(each, (ast.Import, ast.ImportFrom))]
    doc = [each for each in body[:1] if isinstance(each, ast.Expr) and isinstance(constant(each.value), str)]
    return next(iter(imports[-1:] or doc), None)


def _is_imported(module: Module) -> bool:
    """Return whether a file imports legs_loss at its top.

    Raises:
        LegsError: the name is another's, a variable's say.
    """
    scopes = list(module.scopes(lambda text: PACKAGE in text))
    for node in [made.node for scope in scopes for made in scope.flow.definitions.get(PACKAGE, [])]:
        if not isinstance(node, ast.alias) or node.name.split(".")[0] != PACKAGE:
            raise LegsError(f"{module.path} has a {PACKAGE} of its own: rename it, or skip the file with --exclude")
    return PACKAGE in module.top.flow.definitions
