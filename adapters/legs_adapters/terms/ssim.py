"""Recognise calls of functions of a checkout that are 3DGS's SSIM: by their code, in a table of its forms.

The form of a function is its text and that of the functions of the checkout that it calls, word by word: every
operation, constant, default and argument. Local names, functions' names, comments, docstrings, spaces and how torch is
imported make no difference.
"""

from __future__ import annotations

import ast
import builtins
import hashlib
import io
import keyword
import tokenize
from typing import Dict, List, Optional

from legs_adapters.code.module import Function
from legs_adapters.code.program import Program
from legs_adapters.code.syntax import FUNCTIONS, constant, every_parameter
from legs_adapters.terms.form import Form

# The hash of a form, and a repository that has it. Each was evaluated on small images of several shapes:
# it is the mean SSIM with an 11x11 Gaussian window, sigma 1.5, zero padding, C1 = 0.01^2 and C2 = 0.03^2.
FORMS: Dict[str, str] = {
    "e902cb1fd720d8f2": "Anttwo/SuGaR",
    "91a9ec33749c0497": "VITA-Group/LightGaussian",
    "21f9da63921bd88b": "lzhnb/GS-IR",
    "5f64706e613d906a": "VITA-Group/FSGS",
    "7191a23ae8de6faa": "dingdingcai/GSPose",
    "3b43d51ba16bf1a7": "3DGS's order of operations, the tests' script",
}

MAX_FUNCTIONS = 8
_NO_LITERAL = object()
_LAYOUT = (tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT)
_LEFT_OUT = (tokenize.COMMENT, tokenize.NL, tokenize.ENDMARKER, tokenize.ENCODING)


def proven_ssim(program: Program, function: Function, form: Form) -> Optional[Function]:
    """Return the function of a call, where it is 3DGS's SSIM and the further arguments are its defaults."""
    assert form.callee is not None
    target = _called(program, function, form.callee)
    if target is None or not isinstance(target.node, FUNCTIONS):
        return None
    others = list(every_parameter(target.node.args))[2:]
    given = [(target.given(form.call, other.arg), default) for other, default in others]
    is_proven = all(value is None or _are_equal(value, default) for value, default in given)
    return target if is_proven and len(target.parameters) >= 2 and form_of(program, target) in FORMS else None


def _are_equal(value: ast.expr, default: Optional[ast.expr]) -> bool:
    """Return whether an argument is the literal that its parameter has as its default."""
    first, second = constant(value, _NO_LITERAL), constant(default, _NO_LITERAL)
    return first is not _NO_LITERAL and (type(first), first) == (type(second), second)


def form_of(program: Program, function: Function) -> Optional[str]:
    """Return the hash of a function's form; None where it has none, since a name in it is not resolved."""
    functions = [function]
    texts: List[str] = []
    for each in functions:  # which grows
        text = _form(program, each, functions)
        if text is None or len(functions) > MAX_FUNCTIONS:
            return None
        texts.append(text)
    return hashlib.sha256("\n".join(texts).encode()).hexdigest()[:16]


def _form(program: Program, function: Function, functions: List[Function]) -> Optional[str]:
    """Return the words of one function; add those of the checkout that it calls."""
    node = function.node
    if not isinstance(node, FUNCTIONS) or function.owner is not None or function.decorators:
        return None
    with_keywords = [call.func for call in function.flow.calls if any(each.arg for each in call.keywords)]
    if any(_called(program, function, called) for called in with_keywords):
        return None  # a keyword is a name of the other function's
    words: List[str] = []
    local: List[str] = []  # in the order of appearance
    text = io.StringIO(_text(function))
    tokens = [token for token in tokenize.generate_tokens(text.readline) if token.type not in _LEFT_OUT]
    for before, token, after in zip([tokens[-1], *tokens], tokens, [*tokens[1:], tokens[-1]]):
        word = token.string
        is_header = "NEWLINE" not in words
        is_keyword = after.string == "=" and before.string in ("(", ",") and not is_header
        if token.type in _LAYOUT:
            word = tokenize.tok_name[token.type]
        elif token.type == tokenize.NAME and not (keyword.iskeyword(word) or before.string == "." or is_keyword):
            if word not in function.flow.definitions:
                known = _global(program, function, word, functions)
                if known is None:
                    return None
                word = known
            else:
                local += [] if word in local else [word]
                word = f"v{local.index(word)}"
        words.append(word)
    return " ".join(words)


def _text(function: Function) -> str:
    """Return the text of a function, without its docstring."""
    data, place = function.module.lines.data, function.place(function.node)
    doc, *rest = function.body
    at, begin = function.place(doc).start, function.place(rest[0]).start if rest else place.end
    if not isinstance(doc, ast.Expr) or not isinstance(constant(doc.value), str):
        begin = at
    return (data[place.start : at] + (data[begin : place.end] or b"pass") + b"\n").decode("utf-8")


def _global(program: Program, function: Function, name: str, functions: List[Function]) -> Optional[str]:
    """Return what a name that is not local stands for: a function of the checkout its number, a library's its path."""
    node = ast.Name(name, ast.Load())
    called = _called(program, function, node)
    if called is not None:
        functions += [] if called in functions else [called]
        return f"<{functions.index(called)}>"
    references = program.resolve(function, node)
    if len(references) == 1 and references[0].kind == "external":
        return "<" + str(references[0].target).replace(".", " . ")  # as the words of its path
    is_builtin = not references and hasattr(builtins, name) and program.lookup(function, node) is None
    return name if is_builtin else None


def _called(program: Program, function: Function, node: ast.AST) -> Optional[Function]:
    """Return the one function of the checkout that a name refers to."""
    references = program.resolve(function, node)
    target = references[0].target if len(references) == 1 else None
    return target if isinstance(target, Function) else None
