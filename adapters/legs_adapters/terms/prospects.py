"""Find by words which text can lead to an L1, and which can have one: the others are not parsed.

A text leads to one if it mentions one, or a name that does: of a function, of a class whose ``forward`` does, or of a
variable that holds one (``self.criterion = nn.L1Loss()``). It has one if it takes an absolute value, or names what may
be an L1 function: of two parameters, named as a loss or without branches, or what such a function is assigned to or
returned by. False positives are possible, false negatives are not; the search costs a hundredth of parsing.
"""

from __future__ import annotations

import re
from typing import Dict, FrozenSet, Iterable, Iterator, List, NamedTuple, Set, Tuple

from legs_adapters.code.module import CALLED
from legs_adapters.lexicon.words import SPEAKS_OF_L1, SPEAKS_OF_LOSS
from legs_adapters.tensors.operations import HOLDERS

_WORD = re.compile(r"[^\W\d](?<![\w\"'].)\w*(?![\"'])")  # no key, no setting: ``split="train"``
_DEFINITION = re.compile(r"^([ \t]*)(?:async[ \t]+)?(def|class)[ \t]+(\w+)", re.M)
# A value goes on where its line ends in an opening bracket, a comma or a backslash.
_VALUE = r"((?:[^\n]*[\[({,\\][ \t]*(?:#[^\n]*)?(?:\n|\Z))*[^\n]*)"
_GIVEN = re.compile(
    r"^(?:[ \t]*self\.)?(\w+)(?:\[[^\]\n]*\]|\.\w+)*[ \t]*(?::[^=\n]+|[-+*/])?=(?!=)[ \t]*" + _VALUE, re.M
)
_UNPACKED = re.compile(
    r"^(?:[ \t]+(?![ \t])(?=[^=\n]*\bself\.))?[(\[]?((?:[\w.]+[ \t]*,[ \t]*)+[\w.]*)[)\]]?[ \t]*=(?!=)[ \t]*" + _VALUE,
    re.M,
)
_TARGET = re.compile(r"\b(\w+)[ \t]*(?:,|$)")
_RETURNED = re.compile(r"return(?<!\wreturn)[ \t(]+" + _VALUE)
_ADDED = re.compile(r"self(?<!\wself)\.(\w+)\.(?:append|add|extend|update|setdefault)\(([^\n]*)")
_SINGLE_CALL = re.compile(r"(?<![\w.])([\w.]+)[ \t]*\((?:[^()]|\([^()]*\))*\)[ \t]*(?:#.*)?$")
_RENAMED = re.compile(r"as(?<=[ \t]as)[ \t]+(\w+)")
_LAST_WORD = re.compile(r"(?<!\w)\w*$")
_DEFAULT = re.compile(
    r"\b(\w+)(?:[ \t]*:[^=,()\n]{1,200})?[ \t]*=[ \t]*([\w.]{0,99}[lL]1\w{0,99})(?![\w.]{0,99}[ \t]*\()"
)
_BRANCHES = re.compile(r"^[ \t]+(?:if|for|while|with|try|async)\b", re.M)


class _Words(NamedTuple):
    """The names in a text, and whether it speaks of an L1."""

    names: FrozenSet[str]
    speaks: bool

    @classmethod
    def of(cls, text: str) -> _Words:
        return cls(frozenset(_WORD.findall(text)) - {"_"}, SPEAKS_OF_L1.search(text) is not None)


_NONE = _Words(frozenset(), False)
_Entry = Tuple[str, _Words, _Words]  # a name, what it leads through, and what it is an L1 function through


class Prospects:
    """Answer for the texts of one program.

    Args:
        texts: its files.
    """

    def __init__(self, texts: Iterable[str]) -> None:
        entries = [entry for text in texts for entry in _entries(text)]
        self._leading = _closure((name, leads) for name, leads, _ in entries)
        self._l1 = _closure((name, l1) for name, _, l1 in entries)
        self._answers: Dict[str, Tuple[bool, bool]] = {}

    def may_lead(self, text: str) -> bool:
        """Return whether a text can lead to an L1."""
        return self._answer(text)[0]

    def may_have(self, text: str) -> bool:
        """Return whether a text can have an L1 itself."""
        return self._answer(text)[1]

    def may_hold(self, value: str) -> bool:
        """Return whether a value can be an L1 function."""
        words = _held(value)
        return words.speaks or not words.names.isdisjoint(self._l1)

    def _answer(self, text: str) -> Tuple[bool, bool]:
        if text not in self._answers:
            words = _Words.of(text)
            known = (words.speaks or not words.names.isdisjoint(names) for names in (self._leading, self._l1))
            self._answers[text] = tuple(known)  # type: ignore[assignment]
        return self._answers[text]


def _closure(entries: Iterable[Tuple[str, _Words]]) -> Set[str]:
    """Return the names whose words speak of an L1, or mention such a name."""
    entries = list(entries)
    known, found = {name for name, _ in entries}, set()  # type: Set[str], Set[str]
    speakers: Dict[str, List[str]] = {}  # by a word, the names whose definitions mention it
    for name, words in entries:
        for word in known & words.names:
            speakers.setdefault(word, []).append(name)
    work = [name for name, words in entries if words.speaks]
    while work:
        name = work.pop()
        if name not in found:
            found.add(name)
            work += speakers.get(name, ())
    return found


def _entries(text: str) -> Iterator[_Entry]:
    classes: List[Tuple[int, str]] = []
    definitions = [(len(match.group(1)), match) for match in _DEFINITION.finditer(text)]
    for i, (depth, match) in enumerate(definitions):
        after = definitions[i + 1 :]
        if match.group(2) == "def":  # what it defines belongs to it
            after = [each for each in after[:50] if each[0] <= depth] or after[50:]
        body, name = text[match.end() : after[0][1].start() if after else len(text)], match.group(3)
        classes = [entry for entry in classes if entry[0] < depth]
        if match.group(2) == "class":
            classes.append((depth, name))
            continue
        words = _Words.of(body)
        if name in CALLED and classes:
            yield classes[-1][1], words, words
        if not name.endswith("__") and name != "backward":
            returned = [_held(value) for value in _RETURNED.findall(body)]
            yield f"{name}()", _NONE, _NONE if not returned else _joined(returned)
            is_l1 = SPEAKS_OF_LOSS.search(name) or not _BRANCHES.search(body)
            yield name, words, words if is_l1 else _Words(frozenset([f"{name}()"]), False)
    for match in _GIVEN.finditer(text):
        if not match.group(1).endswith("__") and match.group(1) != "_":
            made = _SINGLE_CALL.match(match.group(2))  # what its function makes: arguments do not change that
            single = made is not None and made.group(1) not in HOLDERS
            leads = made.group(1).split(".")[-1] if made and single else match.group(2)
            yield match.group(1), _Words.of(leads), _held(match.group(2))
    named = _ADDED.findall(text)
    for several, value in _UNPACKED.findall(text):
        yield from ((target, _NONE, _held(value)) for target in _TARGET.findall(several))
    named += [found for line in text.split("\n") if "l1" in line.lower() for found in _DEFAULT.findall(line)]
    for match in _RENAMED.finditer(text):
        last = _LAST_WORD.search(text[max(match.start() - 80, 0) : match.start()].rstrip(" \t"))
        named.append((match.group(1), last.group() if last is not None else ""))
    yield from ((name, *[_Words.of(value)] * 2) for name, value in named)


def _joined(several: List[_Words]) -> _Words:
    return _Words(frozenset().union(*(each.names for each in several)), any(each.speaks for each in several))


def _held(value: str) -> _Words:
    """Return the words of a value that may be an L1 function."""
    made = _SINGLE_CALL.match(value)
    if made is not None and made.group(1) not in HOLDERS:
        name = made.group(1).split(".")[-1]
        is_class = name[:1].isupper()
        names = [f"{name}()", name] if is_class else [f"{name}()"]
        return _Words(frozenset(names), is_class and SPEAKS_OF_L1.search(name) is not None)
    return _Words.of(value)
