"""Find by words which text can lead to an L1: the others are not parsed.

A text can lead to one if it mentions one, or a name that does: of a function, of a class whose ``forward`` does, or of
a variable that holds one (``self.criterion = nn.L1Loss()``). False positives are possible, false negatives are not;
the search costs a hundredth of parsing.
"""

from __future__ import annotations

import re
from typing import Dict, Iterable, Iterator, List, Set, Tuple

from legs_adapters.code.module import CALLED
from legs_adapters.lexicon.words import SPEAKS_OF_L1
from legs_adapters.tensors.operations import HOLDERS

__all__ = ["Prospects"]

_WORD = re.compile(r"[^\W\d]\w*")
_DEFINITION = re.compile(r"^([ \t]*)(?:async[ \t]+)?(def|class)[ \t]+(\w+)", re.M)
# A value goes on where its line ends in an opening bracket, a comma or a backslash.
_GIVEN = re.compile(
    r"^(?:[ \t]*self\.)?(\w+)(?:\[[^\]\n]*\]|\.\w+)*[ \t]*(?::[^=\n]+|[-+*/])?=(?!=)[ \t]*"
    r"((?:[^\n]*[\[({,\\][ \t]*(?:#[^\n]*)?\n)*[^\n]*)",
    re.M,
)
_ADDED = re.compile(r"\bself\.(\w+)\.(?:append|add|extend|update|setdefault)\(([^\n]*)")
_SINGLE_CALL = re.compile(r"([\w.]+)[ \t]*\((?:[^()]|\([^()]*\))*\)[ \t]*(?:#.*)?$")
_RENAMED = re.compile(r"\b(\w+)[ \t]+as[ \t]+(\w+)")
_DEFAULT = re.compile(r"\b(\w+)(?:[ \t]*:[^=,()\n]+)?[ \t]*=[ \t]*([\w.]*[lL]1\w*)(?![\w.]*[ \t]*\()")


class Prospects:
    """Answer for the texts of one program.

    Args:
        texts: its files.
    """

    def __init__(self, texts: Iterable[str]) -> None:
        definitions = [definition for text in texts for definition in _definitions(text)]
        known = {name for name, _ in definitions}
        speakers: Dict[str, List[str]] = {}  # by a word, the names whose definitions mention it
        work = [name for name, text in definitions if SPEAKS_OF_L1.search(text)]
        for name, text in definitions:
            for word in known.intersection(_WORD.findall(text)):
                speakers.setdefault(word, []).append(name)
        self._names: Set[str] = set()
        while work:
            name = work.pop()
            if name not in self._names:
                self._names.add(name)
                work += speakers.get(name, ())
        self._answers: Dict[str, bool] = {}

    def may_lead(self, text: str) -> bool:
        """Return whether a text can lead to an L1."""
        if text not in self._answers:
            self._answers[text] = bool(SPEAKS_OF_L1.search(text)) or not self._names.isdisjoint(_WORD.findall(text))
        return self._answers[text]


def _definitions(text: str) -> Iterator[Tuple[str, str]]:
    """Yield names, each with the text of its definition."""
    classes: List[Tuple[int, str]] = []
    definitions = list(_DEFINITION.finditer(text))
    for i, match in enumerate(definitions):
        end = definitions[i + 1].start() if i + 1 < len(definitions) else len(text)
        depth, name = len(match.group(1)), match.group(3)
        classes = [entry for entry in classes if entry[0] < depth]
        if match.group(2) == "class":
            classes.append((depth, name))
        elif not name.startswith("__") and name != "backward":
            yield name, text[match.end() : end]
        if name in CALLED and classes:
            yield classes[-1][1], text[match.end() : end]
    for match in _GIVEN.finditer(text):
        if not match.group(1).startswith("__") and match.group(1) != "_":
            made = _SINGLE_CALL.match(match.group(2))  # what its function makes: arguments do not change that
            single = made is not None and made.group(1) not in HOLDERS
            yield match.group(1), made.group(1).split(".")[-1] if made and single else match.group(2)
    for pattern in (_ADDED, _DEFAULT):
        yield from ((match.group(1), match.group(2)) for match in pattern.finditer(text))
    yield from ((match.group(2), match.group(1)) for match in _RENAMED.finditer(text))
