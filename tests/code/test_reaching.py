"""Reaching definitions: which assignments a read can come from, worked out by hand."""

from __future__ import annotations

import sys

import pytest

from tests.code.support import call, function, program, read, values

CASES = {
    "the last assignment": ("x = 1\nx = 2\nuse(x)", ["2"]),
    "both branches": ("x = 1\nif a:\n    x = 2\nelse:\n    x = 3\nuse(x)", ["2", "3"]),
    "a branch that may not be taken": ("x = 1\nif a:\n    x = 2\nuse(x)", ["1", "2"]),
    "a branch that leaves": ("x = 1\nif a:\n    x = 2\n    return\nuse(x)", ["1"]),
    "a loop's second turn": ("x = 1\nfor i in a:\n    use(x)\n    x = 2", ["1", "2"]),
    "a loop that breaks": ("x = 1\nwhile a:\n    x = 2\n    break\nuse(x)", ["1", "2"]),
    "a loop's else": ("x = 1\nfor i in a:\n    x = 2\nelse:\n    x = 3\nuse(x)", ["3"]),
    "try and except": ("x = 1\ntry:\n    x = 2\nexcept E:\n    x = 3\nuse(x)", ["2", "3"]),
    "finally": ("x = 1\ntry:\n    x = 2\nfinally:\n    x = 3\nuse(x)", ["3"]),
    "unpacking": ("x, y = f(), g()\nuse(y)", ["g()"]),
    "unpacking what a call returns": ("x, y = f()\nuse(y)", ["f()"]),
    "a loop's element": ("for x in cameras:\n    use(x)", ["cameras"]),
    "with": ("with open(p) as x:\n    use(x)", ["open(p)"]),
    "a parameter": ("use(a)", ["parameter"]),
    "an annotation alone": ("x = 1\nx: int\nuse(x)", ["1"]),
    "a chained assignment": ("x = y = f()\nuse(x)", ["f()"]),
}


def body(text):
    lines = "".join(f"    {line}\n" for line in text.splitlines())
    return function(program(f"def step(a):\n{lines}"), "step")


@pytest.mark.parametrize("name", CASES)
def test_what_reaches_a_read(name):
    text, expected = CASES[name]
    where = body(text)
    argument = next(node for node in where.flow.calls if node.func.id == "use").args[0]
    assert values(where.flow.reaching(argument)) == expected


@pytest.mark.skipif(sys.version_info < (3, 8), reason="the syntax is Python 3.8's")
def test_an_assignment_expression_reaches_what_follows():
    where = body("if (x := f()):\n    pass\nuse(x)")
    assert values(where.flow.reaching(read(where, "x"))) == ["f()"]


def test_an_augmented_value_comes_from_both():
    where = body("x = 1\nx += f()\nuse(x)")
    (definition,) = where.flow.reaching(read(where, "x"))
    assert definition.kind == "augment"


def test_an_attribute_is_a_place_of_its_own_until_its_owner_is_another():
    where = body("self.x = 1\nself = b\nuse(self.x)")
    assert values(where.flow.reaching(call(where, "use(self.x)").args[0])) == []


def test_one_assignment_alone_is_the_value_of_a_name():
    where = body("x = f()\ny = 1\nif a:\n    y = 2\nuse(x, y)")
    given = call(where, "use(x, y)").args
    assert where.flow.value_of(given[0]).func.id == "f"
    assert where.flow.value_of(given[1]) is None
