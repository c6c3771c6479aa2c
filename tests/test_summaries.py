"""The first line of a docstring describes a function in the imperative, a class or a module as a noun."""

from __future__ import annotations

import ast

import pytest

from tests.support import ROOT

QUESTIONS = {"How", "What", "When", "Where", "Whether", "Which", "Who", "Why"}
ARTICLES = {"A", "An", "Each", "The", "This"}
FILES = sorted((ROOT / "legs_loss").rglob("*.py"))
OTHERS = sorted(path for folder in ("adapters", "benchmarks", "tests") for path in (ROOT / folder).rglob("*.py"))


def summaries(path):
    """Yield line, first word and whether it is a function's, of each docstring in a file."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
            words = (ast.get_docstring(node) or "").split()
            if words:
                yield getattr(node, "lineno", 1), words[0], isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_a_summary_begins_with_a_verb_or_a_noun(path):
    wrong = [(line, word) for line, word, does in summaries(path) if word in QUESTIONS | (ARTICLES if does else set())]
    assert wrong == []


@pytest.mark.parametrize("path", OTHERS, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_a_summary_asks_no_question(path):
    assert [(line, word) for line, word, _ in summaries(path) if word in QUESTIONS] == []
