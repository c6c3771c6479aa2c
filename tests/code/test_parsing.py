"""Each node of a file stands where it stands there, on every Python."""

from __future__ import annotations

import ast
from contextlib import suppress
from pathlib import Path
from typing import Iterator

import pytest
from legs_adapters.code.module import Class, Function, Module, parse
from legs_adapters.code.parsing import Lines
from legs_adapters.code.sources import Source, Unreadable
from legs_adapters.code.syntax import FUNCTIONS, code, same, walk_expressions

from tests.code.support import program

FILES = sorted(Path(__file__).parent.glob("test_*.py"))

AWKWARD = '''# é: bytes and letters are counted apart
"""A docstring
def not_a_function():
    pass
"""
import torch
def one(a): return a
def continued(a): \\
    return a
def commented(a):  # of what follows
    # before the first statement

    return a  # after the last

    # still inside
# outside

class Outer(torch.nn.Module):
\tdef method(self, x):
\t\t"""Not
    indented."""
\t\t@decorated(
\t\t\tx
\t\t)
\t\tasync def nested(y, z=lambda: 1):
\t\t\treturn await y

\t\treturn nested(x); y = 2
\tclass Inner:
\t\tasync def other(self): return 1
if torch:
    def here():
        yield from [1, 2]
elif one:
    def here():
        return """
dedented"""
else:
    try:
        def here(): pass
    finally:
        def here():

            class Local:
                def deep(self):
                    return 7
            return Local
def last(*, a=1, **more) -> "int":
    return 1 + \\
        2'''


def check(text: str) -> Module:
    module = parse(Source("file.py", text.encode(), text))
    assert isinstance(module, Module)
    wanted = [node.name for node in ast.walk(ast.parse(text)) if isinstance(node, FUNCTIONS)]
    functions = [*module.scopes(bool)]
    assert sorted(function.name for function in functions[1:]) == sorted(wanted)
    tree = functions[0].node
    inside = {id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in ast.walk(node)}
    counted = 0
    for function in functions:
        for node in walk_expressions(*function.body):
            has_slice = any(isinstance(part, ast.Slice) for part in walk_expressions(node))
            if not isinstance(node, (ast.expr, ast.stmt)) or isinstance(node, ast.Starred) or has_slice:
                continue
            if id(node) in inside or any(id(part) in inside for part in ast.walk(node)):
                continue  # before Python 3.12 places in f-strings are off
            place = function.place(node)
            assert text.encode()[place.start : place.end].decode() == code(node)
            before = text.encode()[: place.start].replace(b"\r\n", b"\n").replace(b"\r", b"\n")
            assert place.line == before.count(b"\n") + 1
            if isinstance(node, ast.expr):
                (read,) = Lines(f"({code(node)}\n)".encode()).tree().body
                assert same(read.value, node)
                counted += 1
    assert counted > 10
    return module


@pytest.mark.parametrize("newline", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("end", ["", "\n"])
def test_every_node_stands_where_it_stands_in_the_file(newline: str, end: str) -> None:
    check((AWKWARD + end).replace("\n", newline))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_every_node_of_a_real_file_stands_where_it_stands(path: Path) -> None:
    check(path.read_text(encoding="utf-8"))


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("f(a)", "a"),
        ("f((a))", "(a)"),
        ("f((a),)", "(a)"),
        ("f(x)((a), b)", "(a)"),
        ("x[(a)]", "(a)"),
        ("((a) - b).abs()", "(a)"),
        ("y = ( # c\n    (a)  # d\n)", "( # c\n    (a)  # d\n)"),
        ("print( ( a ) )", "( a )"),
        ("lambda: (a)", "(a)"),
        ("def f():\n    return (a)", "(a)"),
        ("b = 'é' and (a)", "(a)"),
        ("b = '''\n日本語'''; (a)", "(a)"),
        ("b('''\n日本語''', (a))", "(a)"),
    ],
)
def test_brackets_around_a_node_are_its_own_and_not_a_calls(text: str, wanted: str) -> None:
    module = Module("file.py", text)
    (node,) = [node for node in ast.walk(module.top.node) if isinstance(node, ast.Name) and node.id == "a"]
    place = module.top.place(node, brackets=True)
    assert text.encode()[place.start : place.end].decode() == wanted


def named(module: Module, name: str) -> Function:
    return next(function for function in module.scopes(bool) if function.name == name)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("def f(:\n    pass\n", "does not parse (line 1: "),
        ("x = 1\n\n\ndef f():\n    return 1 2\n", "does not parse (line 5: "),
        ("x = 1\0\n", "does not parse ("),
    ],
)
def test_what_does_not_parse_is_said_of_the_file(text: str, reason: str) -> None:
    found = parse(Source("file.py", text.encode(), text))
    assert isinstance(found, Unreadable)
    assert found.reason.startswith(reason)
    assert "None" not in found.reason


@pytest.mark.parametrize("end", ["\\\n", "\\\r\n", " \\\n\n"])
def test_a_file_that_ends_in_a_backslash_is_read_or_said_not_to_parse(end: str) -> None:
    text = f"f((a))\n{end}"
    found = parse(Source("file.py", text.encode(), text))
    if isinstance(found, Unreadable):
        assert found.reason.startswith("does not parse (")
    else:
        (node,) = [node for node in ast.walk(found.top.node) if isinstance(node, ast.Name) and node.id == "a"]
        assert code(node, True) == "(a)"


STORED = """
self.x = 1
self.x: int = 1
self.x += 1
self.x **= 2
self.x[0] = 1
self.x[
    0
] = 1
self.x[i].y = 1
a, self.x = 1, 2
self.x, a = 1, 2
(self.x, a) = 1, 2
(
    a,
    self.x,
) = 1, 2
(
    a,
    self.x[0]
) = 1, 2
(self.x,\r
 a) = 1, 2
a = self.x = 1
self.x.append(1)
self.x.update({1: 2})
self.x.mul_(2)
for self.x in a: pass
for i, self.x in a: pass
with a as self.x: pass
"""


def statements(text: str) -> Iterator[str]:
    """Yield the statements of a text; before Python 3.8 their last lines are not known to ast."""
    statement = ""
    for line in text.strip().splitlines():
        statement += f"{line}\n"
        with suppress(SyntaxError):
            ast.parse(statement)
            yield statement
            statement = ""


@pytest.mark.parametrize("statement", statements(STORED))
def test_what_a_method_stores_is_found(statement: str) -> None:
    body = "".join(f"        {line}\n" for line in statement.splitlines())
    made = program(
        f"class A:\n    def f(self, a, i):\n{body}\n    def g(self, a):\n        return self.x, a == self.x\n"
    )
    module = made.module("main.py")
    (owner,) = [each for each in module.by_node.values() if isinstance(each, Class)]
    assert [method.name for method, _ in owner.stores("x")] == ["f"]
