"""A file that is parsed in parts is read as one that is parsed as a whole."""

from __future__ import annotations

import ast
import sys
from contextlib import suppress
from pathlib import Path
from typing import Iterator

import pytest

cst = pytest.importorskip("libcst")

from legs_adapters.code.module import Class, Function, Module, parse  # noqa: E402
from legs_adapters.code.parsing import Lines, Part  # noqa: E402
from legs_adapters.code.sources import Source, Unreadable  # noqa: E402
from legs_adapters.code.syntax import code, walk_expressions  # noqa: E402
from legs_adapters.terms.prospects import Prospects  # noqa: E402
from libcst.metadata import ByteSpanPositionProvider, MetadataWrapper  # noqa: E402

from tests.code.support import program  # noqa: E402

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
    whole = cst.parse_module(text)
    data = text.encode()
    wanted = [node.name.value for node in _functions(whole)]
    functions = [*module.scopes(bool)]
    assert [function.name for function in functions[1:]] == wanted
    counted = 0
    for function in functions:
        for node in walk_expressions(function.body):
            if isinstance(node, (cst.Name, cst.SimpleString, cst.Integer)):
                place = function.place(node)
                assert data[place.start : place.end].decode() == code(node)
                before = data[: place.start].replace(b"\r\n", b"\n").replace(b"\r", b"\n")
                assert place.line == before.count(b"\n") + 1
                counted += 1
    assert counted > 10
    return module


def _functions(tree: cst.Module) -> list:
    found = []

    class Visitor(cst.CSTVisitor):
        def visit_FunctionDef(self, node: cst.FunctionDef) -> None:
            found.append(node)

    tree.visit(Visitor())
    return found


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
@pytest.mark.parametrize("end", ["", "\n"])
def test_every_node_stands_where_it_stands_in_the_file(newline: str, end: str) -> None:
    check((AWKWARD + end).replace("\n", newline))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_every_node_of_a_real_file_stands_where_it_stands(path: Path) -> None:
    check(path.read_text(encoding="utf-8"))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_the_span_of_every_node_is_that_of_libcst(path: Path) -> None:
    """Its own provider, over the whole file: calls, arguments and statements begin and end where it says."""
    data = path.read_bytes()
    part = Part(Lines(data), data)
    spans = MetadataWrapper(part.tree, unsafe_skip_copy=True).resolve(ByteSpanPositionProvider)
    kinds = (cst.Arg, cst.BaseExpression, cst.BaseSmallStatement, cst.BaseStatement)
    nodes = [node for node in spans if isinstance(node, kinds)]
    assert len(nodes) > 100
    for node in nodes:
        place = part.place(node)
        assert (place.start, place.end - place.start) == (spans[node].start, spans[node].length), code(node)


def named(module: Module, name: str) -> Function:
    return next(function for function in module.scopes(bool) if function.name == name)


def test_a_body_is_parsed_only_when_it_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    parsed = []
    real = cst.parse_module
    monkeypatch.setattr(cst, "parse_module", lambda text: parsed.append(text) or real(text))
    module = check("import a\n\n\ndef f(x):\n    return b(x, 1, 2, 3, 4, 5)\n\n\ndef g():\n    return c(1, 2, 3, 4)\n")
    parsed.clear()
    again = Module("file.py", module.text)
    if len(again.outline_text) < len(module.text):  # before Python 3.8 a file is parsed as a whole
        assert not any("return" in text for text in parsed)
        assert [f.name for f in again.scopes(lambda text: "c(" in text)] == ["g"]
        named(again, "f").flow.calls.clear()
        assert any("b(x" in text for text in parsed) and not any("c(1" in text for text in parsed)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("def f(:\n    pass\n", "does not parse (line 1: "),
        ("x = 1\n\n\ndef f():\n    return 1 2\n", "does not parse (line 5: "),
    ],
)
def test_what_does_not_parse_is_said_of_the_file(text: str, reason: str) -> None:
    found = parse(Source("file.py", text.encode(), text))
    assert isinstance(found, Unreadable)
    assert found.reason.startswith(reason)


@pytest.mark.skipif(sys.version_info < (3, 8), reason="LibCST of Python 3.7 has a parser of its own")
def test_what_python_reads_and_libcst_does_not_is_said_so_with_the_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(text: str) -> None:
        if text.startswith("async def _()"):
            raise cst.ParserSyntaxError("no", lines=text.splitlines(True), raw_line=3, raw_column=0)
        return parse_module(text)

    parse_module = cst.parse_module
    monkeypatch.setattr(cst, "parse_module", refuse)
    text = "import a\n\n\ndef f(x):\n    y = x\n    return y\n"
    found = parse(Source("file.py", text.encode(), text))
    assert isinstance(found, Module)
    assert named(found, "f").flow.calls == []
    assert found.failure == Unreadable("file.py", "does not parse (line 6: Python reads it, and LibCST does not)")


@pytest.mark.parametrize(
    "text",
    [
        "def training():\n    loss = l1_loss(a, b)\n",
        "def inner(a, b):\n    return (a - b).abs()\ndef middle(c):\n    inner(c, c)\ndef training():\n    middle(1)\n",
        "class T:\n    def __init__(self):\n        self.f = L1Loss()\n    def training(self):\n        self.f(1, 2)\n",
        "class C:\n    def forward(self, a, b):\n        abs(a - b)\nphoto = C()\ndef training():\n    photo(1, 2)\n",
        "from losses import l1_loss as photometric\ndef training():\n    photometric(1, 2)\n",
        "LOSSES = {\n    'rgb': l1_loss,\n}\ndef training():\n    LOSSES['rgb'](1, 2)\n",
        "def training(criterion=F.l1_loss):\n    criterion(1, 2)\n",
    ],
)
def test_what_can_lead_to_an_l1_is_found_by_its_words(text: str) -> None:
    other = "def render(camera):\n    return camera.project(points)\n"
    prospects = Prospects([text + other])
    module = Module("file.py", text + other)
    assert prospects.may_lead(named(module, "training").text)
    if len(module.outline_text) < len(module.text):
        assert not prospects.may_lead(named(module, "render").text)


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("def photo(a, b):\n    return (a - b).abs().mean()\n", "photo"),
        ("def photo(a, b, mask):\n    for m in mask:\n        a = a * m\n    return F.l1_loss(a, b)\n", "photo"),
        ("def inner(a, b):\n    return torch.abs(a - b)\ndef outer(a, b):\n    return inner(a, b)\n", "outer"),
        ("class Photo:\n    def forward(self, a, b):\n        return abs(a - b)\nphoto = Photo()\n", "photo"),
        ("class A:\n    def __init__(self):\n        self.photo, self.x = nn.L1Loss(), 1\n", "self.photo"),
        ("class A:\n    def __init__(self):\n        self.__photo = nn.L1Loss()\n", "self.__photo"),
        ("def make(kind):\n    return F.l1_loss if kind else F.mse_loss\nclass A:\n    def f(self):\n"
         "        self.photo = make(1)\n", "self.photo"),
        ("def make(kind):\n    def difference(a, b):\n        return (a - b).abs()\n    return difference\n"
         "photo = make(1)\n", "photo"),
        ("def make():\n    return {\n        'photo': F.l1_loss,\n    }\nTABLE = make()\n", "TABLE"),
        ("photo = functools.partial(F.l1_loss, reduction='none')\n", "photo"),
        ("from losses import l1_loss as photo\n", "photo"),
    ],
)  # fmt: skip
def test_what_may_be_an_l1_function_is_found_by_its_words(text: str, name: str) -> None:
    other = "def plain(a, b):\n    return a * b\nscaled = photometric(1, 2) * 3\n"
    assert Prospects([text + other]).may_have(name)
    for unlike in ("plain", "scaled", "self.plain", "train"):
        assert not Prospects([text + other]).may_have(unlike)


def test_a_function_and_a_module_can_be_held() -> None:
    text = "def photo(a, b):\n    return (a - b).abs().mean()\nloss = photo(1, 2)\n"
    prospects = Prospects([text])
    assert prospects.may_have("photo") and prospects.may_lead("loss") and not prospects.may_have("scaled")
    assert prospects.may_hold("photo") and prospects.may_hold("nn.L1Loss()") and not prospects.may_hold("scaled(1, 2)")


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
