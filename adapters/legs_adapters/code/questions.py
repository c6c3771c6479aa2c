"""Answer questions about expressions that depend on one another, in loops too: a fixed point of a dataflow analysis."""

from __future__ import annotations

import heapq
from dataclasses import dataclass, field
from typing import Any, Callable, Dict, List, Optional, Set, Tuple, TypeVar

from legs_adapters.code.module import Function

_DEPTH = 200  # questions in one another; deeper ones are answered afterwards, and those that asked are asked again
_TURNS = 8  # that one is answered in, in a loop

_S = TypeVar("_S")
_A = TypeVar("_A")


@dataclass(eq=False)
class _Question:
    """A question that is not settled yet, its answer so far, and those who were given that."""

    order: int
    function: Function
    subject: Any
    ask: Callable[[Function, Any], Any]
    answer: Any
    readers: Set[_Question] = field(default_factory=set)
    turns: int = 0
    is_waiting: bool = False


class Questions:
    """The answers to questions about the expressions of one program, each remembered."""

    def __init__(self) -> None:
        self._known: Dict[Tuple[str, int], Any] = {}
        self._asked: Dict[Tuple[str, int], _Question] = {}  # since the outermost question
        self._waiting: List[Tuple[int, _Question]] = []  # to be answered, or again: those that were asked last first
        self._reader: Optional[_Question] = None
        self._depth = 0

    def answer(self, function: Function, subject: _S, ask: Callable[[Function, _S], _A], nothing: _A) -> _A:
        """Answer a question once; where it depends on itself, as a fixed point.

        Everything that was asked on the way is settled, and remembered, when the outermost question is.

        Args:
            function, subject: where it is asked, and what about.
            ask: the function that answers it, with the answers to others.
            nothing: its answer while it is open, and for a file that is over its budget.
        """
        key = ask.__name__, id(subject)
        if key in self._known:
            return self._known[key]
        question = self._asked.get(key)
        if question is None:
            question = self._asked[key] = _Question(len(self._asked), function, subject, ask, nothing)
            if self._reader is None:
                self._settle(question)
                return question.answer
            if self._depth < _DEPTH:
                self._turn(question)
            else:
                self._wait(question)
        assert self._reader is not None
        question.readers.add(self._reader)
        return question.answer

    def _settle(self, question: _Question) -> None:
        self._wait(question)
        try:
            while self._waiting:
                self._turn(heapq.heappop(self._waiting)[1])
            self._known.update((key, asked.answer) for key, asked in self._asked.items())
        finally:
            self._asked.clear()
            self._waiting.clear()

    def _wait(self, question: _Question) -> None:
        if not question.is_waiting:
            question.is_waiting = True
            heapq.heappush(self._waiting, (-question.order, question))

    def _turn(self, question: _Question) -> None:
        """Answer a question; where the answer is another than before, whoever was given that one has a turn."""
        question.is_waiting = False
        question.turns += 1
        if question.turns > _TURNS or not question.function.module.spend(2):
            return
        reader, self._reader = self._reader, question
        self._depth += 1
        try:
            answer = question.ask(question.function, question.subject)
        finally:
            self._reader = reader
            self._depth -= 1
        if answer != question.answer:
            question.answer = answer
            for each in question.readers:
                self._wait(each)
