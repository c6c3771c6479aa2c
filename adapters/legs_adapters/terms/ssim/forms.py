"""Recognise the functions of a checkout that are 3DGS's SSIM: by their code, in a table of the forms it is met in.

Of a function and of those of the checkout that it calls, a normal form keeps every operation, constant, default and
argument; local names, annotations, comments, docstrings and how torch is imported make no difference.
"""

from __future__ import annotations

import builtins
import dataclasses
import functools
import hashlib
from typing import Any, Dict, List, Optional

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.program import Program
from legs_adapters.code.syntax import dotted

__all__ = ["FORMS", "form_of"]

# The hash of a normal form, and a repository that has it. Each was evaluated on small images of several shapes:
# it is the mean SSIM with an 11x11 Gaussian window, sigma 1.5, zero padding, C1 = 0.01^2 and C2 = 0.03^2.
FORMS: Dict[str, str] = {
    "4742a8b08f0f5731": "Anttwo/SuGaR",
    "bd80856ed24db553": "VITA-Group/FSGS",
    "f2ac2c5303dd42c4": "zju3dv/street_gaussians",
    "1cd3222ad3506070": "OUC-voyage/SVGS",
    "6c10370305562e77": "dingdingcai/GSPose",
    "e5a0078ed3934fdf": "ladvu/RiGS",
    "f768fa8004c02263": "TQTQliu/MVSGaussian",
    "c58ad32e448022c5": "jkulhanek/wild-gaussians",
    "94f9941284209da0": "3DGS's order of operations, the tests' script",
}

MAX_FUNCTIONS = 8
_NO_PART = (cst.FunctionDef, cst.ClassDef, cst.Lambda, cst.Import, cst.ImportFrom, cst.Global, cst.Nonlocal)
_WITHOUT_EFFECT = (
    *(cst.Annotation, cst.BaseParenthesizableWhitespace, cst.EmptyLine, cst.TrailingWhitespace),
    *(cst.Comma, cst.Semicolon, cst.LeftParen, cst.RightParen),
)


@functools.lru_cache(maxsize=8)  # every call of a function asks
def form_of(program: Program, function: Function) -> Optional[str]:
    """Return the hash of a function's normal form; None where it has none, since a name in it is not resolved."""
    functions = [function]
    try:
        texts = [_Writer(program, each, functions).text() for each in functions]  # which appends those it calls
    except _NoForm:
        return None
    return hashlib.sha256("\n".join(texts).encode()).hexdigest()[:16]


class _NoForm(Exception):
    """The function has no normal form."""


class _Writer:
    """Writes one function; the functions that it calls are numbered in the order of their calls."""

    def __init__(self, program: Program, function: Function, functions: List[Function]) -> None:
        self._program, self._function, self._functions = program, function, functions
        self._locals: List[str] = []  # in the order of appearance

    def text(self) -> str:
        """Return the normal form of the function by itself."""
        node, statements = self._function.node, list(self._function.body.body)
        is_method = self._function.owner is not None and "staticmethod" not in self._function.decorators
        if not isinstance(node, cst.FunctionDef) or node.asynchronous is not None or is_method:
            raise _NoForm
        if node.with_changes(body=self._function.body).get_docstring(clean=False) is not None:
            del statements[0]
        return self._written([node.params, node.decorators, statements])

    def _written(self, part: Any) -> str:
        if isinstance(part, (list, tuple)):
            return f"[{' '.join(filter(None, map(self._written, part)))}]"
        if isinstance(part, str):
            return part
        if not isinstance(part, cst.CSTNode) or isinstance(part, _WITHOUT_EFFECT):
            return ""
        if isinstance(part, _NO_PART):
            raise _NoForm
        place = dotted(part)
        if place is not None and place.split(".")[0] not in self._function.flow.definitions:
            return self._global(part, place)
        if isinstance(part, cst.Name):
            return self._local(part.value)
        if isinstance(part, cst.Attribute):
            return f"{self._written(part.value)}.{part.attr.value}"
        if isinstance(part, cst.Call):
            called = self._called(part.func)
            return f"{self._written(part.func)}({', '.join(self._argument(arg, called) for arg in part.args)})"
        parts = ", ".join(self._written(getattr(part, field.name)) for field in dataclasses.fields(part))
        return f"{type(part).__name__}({parts})"

    def _argument(self, arg: cst.Arg, called: Optional[Function]) -> str:
        """Return an argument; its keyword as the number of the parameter, where that is of the checkout."""
        keyword = arg.keyword.value if arg.keyword is not None else ""
        if keyword and called is not None:
            if keyword not in called.parameters:
                raise _NoForm
            keyword = f"<{called.parameters.index(keyword)}>"
        return f"{arg.star}{keyword}={self._written(arg.value)}"

    def _local(self, name: str) -> str:
        """Return the number of a local name."""
        if name not in self._locals:
            self._locals.append(name)
        return f"v{self._locals.index(name)}"

    def _global(self, node: cst.CSTNode, place: str) -> str:
        """Return a name that is not local: the full name of a library's, the number of a function of the checkout."""
        called = self._called(node)
        if called is not None:
            if called not in self._functions:
                self._functions.append(called)
            if len(self._functions) > MAX_FUNCTIONS:
                raise _NoForm
            return f"<{self._functions.index(called)}>"
        references = self._program.resolve(self._function, node)
        if len(references) == 1 and references[0].kind == "external":
            return f"<{references[0].target}>"
        if references or not hasattr(builtins, place) or self._program.lookup(self._function, node) is not None:
            raise _NoForm
        return place

    def _called(self, node: cst.CSTNode) -> Optional[Function]:
        """Return the one function of the checkout that a name refers to."""
        references = self._program.resolve(self._function, node)
        target = references[0].target if len(references) == 1 else None
        return target if isinstance(target, Function) else None
