"""Programs of a few lines, and the nodes in them, for tests of the code analysis."""

from __future__ import annotations

import ast

from legs_adapters.code.program import Program
from legs_adapters.code.sources import Source
from legs_adapters.code.syntax import code
from legs_adapters.tensors.operations import MODULE_SELF, MODULE_WRAPS


def program(files):
    """Return the program of {path: text}, or of one text as main.py."""
    files = {"main.py": files} if isinstance(files, str) else files
    return Program([Source(path, text.encode(), text) for path, text in files.items()], MODULE_SELF, MODULE_WRAPS)


def scopes(made):
    """Return every function and top level of a program."""
    modules = [made.module(path) for path in made.sources]
    return [scope for module in modules for scope in module.scopes(lambda text: True)]


def function(made, name):
    """Return the one function of a name."""
    (found,) = [scope for scope in scopes(made) if scope.name == name]
    return found


def read(where, name):
    """Return the last read of a name in a function."""
    return [node for node in where.flow.reads if node.id == name][-1]


def call(where, text):
    """Return the call that is written so."""
    return next(node for node in where.flow.calls if code(node) == text)


def values(definitions):
    """Return the definitions that reach a place, as text: the value, or the kind where there is none."""
    said = [d.kind if not isinstance(d.value, ast.expr) else code(d.value) for d in definitions]
    return sorted(said)
