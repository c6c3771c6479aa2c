"""Recognise the functions of a checkout that are 3DGS's SSIM: by their code, in a table of the forms it is met in.

Of a function and of those of the checkout that it calls, a normal form keeps every operation, constant, default and
argument; local names, annotations, comments, docstrings and how torch is imported make no difference.
"""

from __future__ import annotations

import ast
import builtins
import hashlib
from typing import Any, Dict, List, Optional

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.program import Program
from legs_adapters.code.syntax import code, every_parameter

__all__ = ["FORMS", "form_of"]

# The hash of a normal form, and a repository that has it. Each was evaluated on small images of several shapes:
# it is the mean SSIM with an 11x11 Gaussian window, sigma 1.5, zero padding, C1 = 0.01^2 and C2 = 0.03^2.
FORMS: Dict[str, str] = {
    "179a0021ad236a36": "Anttwo/SuGaR",
    "f7823866407f03d7": "VITA-Group/FSGS",
    "3222335dc1ad1d77": "zju3dv/street_gaussians",
    "00b290414f6829db": "OUC-voyage/SVGS",
    "c5d6c795add3ba5c": "dingdingcai/GSPose",
    "abc532efe80a598b": "ladvu/RiGS",
    "7798f5b2ab373e4f": "TQTQliu/MVSGaussian",
    "97b122ab2ff22698": "jkulhanek/wild-gaussians",
    "b41432d1bfd09ba7": "3DGS's order of operations, the tests' script",
}

_MOST_FUNCTIONS = 8
_CONSTANTS = {"Constant": "value", "Num": "n", "Str": "s", "NameConstant": "value"}  # the last three in Python 3.7
_SCOPES = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef, ast.Lambda)
_NO_PART = (*_SCOPES, ast.Import, ast.ImportFrom, ast.Global, ast.Nonlocal)
_UNSAID = ("ctx", "kind", "type_comment", "type_ignores", "type_params", "annotation", "returns", "name")


def form_of(program: Program, function: Function) -> Optional[str]:
    """Return the hash of a function's normal form; None where it has none, since a name in it is not resolved."""
    functions = [function]
    try:
        texts = [_Writer(program, each, functions).written() for each in functions]  # which appends those it calls
    except (_NoForm, SyntaxError, ValueError):
        return None
    return hashlib.sha256("\n".join(texts).encode()).hexdigest()[:16]


class _NoForm(Exception):
    """The function has no normal form."""


class _Writer:
    """Writes one function; the functions that it calls are numbered in the order of their calls."""

    def __init__(self, program: Program, function: Function, functions: List[Function]) -> None:
        self._program, self._function, self._functions = program, function, functions
        self._locals: Dict[str, str] = {}

    def written(self) -> str:
        """Return the normal form of the function by itself."""
        node = self._function.node
        method = self._function.owner is not None and not self._function.static
        if not isinstance(node, cst.FunctionDef) or node.asynchronous is not None or method:
            raise _NoForm
        tree = ast.parse(code(node.with_changes(body=self._function.body, leading_lines=()))).body[0]
        assert isinstance(tree, ast.FunctionDef)
        if ast.get_docstring(tree, clean=False) is not None:
            del tree.body[0]
        inside = [part for part in ast.walk(tree) if part is not tree]
        if any(isinstance(part, _NO_PART) for part in inside):
            raise _NoForm
        named = [part.arg for part in inside if isinstance(part, ast.arg)]
        named += [part.id for part in inside if isinstance(part, ast.Name) and isinstance(part.ctx, ast.Store)]
        outside = [*tree.decorator_list, *tree.args.defaults, *filter(None, tree.args.kw_defaults)]
        if any(isinstance(part, ast.Name) and part.id in named for each in outside for part in ast.walk(each)):
            raise _NoForm  # a global of a local's name
        self._locals = dict.fromkeys(named, "")
        return self._text(tree)

    def _text(self, node: Any) -> str:
        if isinstance(node, list):
            return f"[{', '.join(map(self._text, node))}]"
        if not isinstance(node, ast.AST):
            return repr(node)
        kind, parts = type(node).__name__, dict(ast.iter_fields(node))
        if kind in _CONSTANTS:
            return repr(parts[_CONSTANTS[kind]])
        if kind in ("Index", "ExtSlice"):  # until Python 3.8
            return self._text(parts["value"]) if kind == "Index" else f"Tuple(elts={self._text(parts['dims'])})"
        place = _place(node)
        if place and place.split(".")[0] not in self._locals:
            return self._global(place)
        if isinstance(node, (ast.Name, ast.arg)):
            return self._local(node.id if isinstance(node, ast.Name) else node.arg)
        if isinstance(node, ast.AnnAssign) and node.value is not None:
            kind, parts = "Assign", {"targets": [node.target], "value": node.value}
        said = {
            name: self._text(part) for name, part in parts.items() if name not in _UNSAID and part not in (None, [])
        }
        if isinstance(node, ast.Call) and node.keywords:
            said["keywords"] = self._keywords(node)
        return f"{kind}({', '.join(f'{name}={text}' for name, text in said.items())})"

    def _local(self, name: str) -> str:
        """Return the number of a local name, in the order of appearance."""
        if not self._locals[name]:
            self._locals[name] = f"v{sum(map(bool, self._locals.values()))}"
        return self._locals[name]

    def _global(self, place: str) -> str:
        """Return a name that is not local: the full name of a library's, the number of a function of the checkout."""
        called = self._called(place)
        if called is not None:
            if called not in self._functions:
                self._functions.append(called)
            if len(self._functions) > _MOST_FUNCTIONS:
                raise _NoForm
            return f"<{self._functions.index(called)}>"
        node = cst.parse_expression(place)
        references = self._program.resolve(self._function, node)
        if len(references) == 1 and references[0].kind == "external" and not references[0].guess:
            return f"<{references[0].target}>"
        if references or not hasattr(builtins, place) or self._program.lookup(self._function, node) is not None:
            raise _NoForm
        return place

    def _called(self, place: str) -> Optional[Function]:
        """Return the one function of the checkout that a name refers to."""
        references = self._program.resolve(self._function, cst.parse_expression(place))
        target = references[0].target if len(references) == 1 and not references[0].guess else None
        return target if isinstance(target, Function) else None

    def _keywords(self, node: ast.Call) -> str:
        """Return the keywords of a call: of a function of the checkout, whose names are local, by their position."""
        place = _place(node.func)
        called = self._called(place) if place and place.split(".")[0] not in self._locals else None
        names = [str(keyword.arg) for keyword in node.keywords]
        if called is not None and isinstance(called.node, cst.FunctionDef):
            parameters = [param.name.value for param in every_parameter(called.node.params)]
            if not set(names) <= set(parameters):
                raise _NoForm
            names = [f"<{parameters.index(name)}>" for name in names]
        return ", ".join(f"{name}: {self._text(keyword.value)}" for name, keyword in zip(names, node.keywords))


def _place(node: ast.AST) -> str:
    """Return ``a.b.c`` for a chain of names; empty for anything else."""
    if isinstance(node, ast.Name):
        return node.id
    base = _place(node.value) if isinstance(node, ast.Attribute) else ""
    return f"{base}.{node.attr}" if base and isinstance(node, ast.Attribute) else ""
