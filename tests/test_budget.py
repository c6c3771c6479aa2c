"""The budget of lines of code and of words: what a change adds, another part gives; lowered where a change earns it.

A line counts that has code: no blank line, comment, docstring or import.
"""

from __future__ import annotations

import ast
import functools
import io
import tokenize

import pytest

from tests.support import ROOT

NOT_CODE = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}
# What there is at most.
MOST = {"patcher": 4800, "adapters": 6500, "legs_loss": 11000, "all": 17500}
MOST_WORDS = {"README": 700, "docs": 25000}


def code_lines(text: str) -> int:
    """Return how many lines of a file have code."""
    ignored = set()
    for node in ast.walk(ast.parse(text)):
        documented = isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef))
        if documented and ast.get_docstring(node, clean=False) is not None:
            node = node.body[0]
        elif not isinstance(node, (ast.Import, ast.ImportFrom)):
            continue
        ignored.update(range(node.lineno, node.end_lineno + 1))
    used = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in NOT_CODE:
            used.update(range(token.start[0], token.end[0] + 1))
    return len(used - ignored)


@functools.lru_cache(maxsize=None)
def counted():
    """Return the lines of code by part."""
    found = dict.fromkeys(MOST, 0)
    for folder, part in (("legs_loss", "legs_loss"), ("adapters/legs_adapters", "adapters")):
        for path in (ROOT / folder).rglob("*.py"):
            lines = code_lines(path.read_text(encoding="utf-8"))
            others = {"shims", "upstreams"} & set(path.parts)
            for name in ("all", part, *(["patcher"] if part == "adapters" and not others else [])):
                found[name] += lines
    return found


def test_a_line_counts_that_has_code():
    text = '"""A page.\n\nOf two lines."""\n\nimport os\n\n\n'
    text += 'def f(a):\n    """Say."""\n    # why\n    return (\n        a\n    )\n'
    assert code_lines(text) == 4
    assert code_lines('TEXT = """one\n\ntwo"""\n') == 3


@pytest.mark.parametrize("part", MOST)
def test_the_code_is_within_its_budget(part):
    assert counted()[part] <= MOST[part]


def test_the_words_are_within_their_budget():
    readme = len((ROOT / "README.md").read_text(encoding="utf-8").split())
    docs = sum(len(path.read_text(encoding="utf-8").split()) for path in (ROOT / "docs").rglob("*.md"))
    assert readme <= MOST_WORDS["README"]
    assert docs <= MOST_WORDS["docs"]
