"""Switch off each part of legs-patch in turn: in how many checkouts are other lines weighted, or none?

A part is a rule, a form of term, a list of words or a reader (of masks, error maps, other uses of a function). One
that is switched off behaves as if it did not exist. A checkout is parsed once, in a process of its own. Each part with
a say in its plan is switched off in a forked copy of that process, which plans again. A part that had none cannot
change the plan: the rule decided nothing, no expression was of the form, no identifier contained a word of the list.

Parts overlap: what one leaves, another may leave, too. So the table does not say what goes wrong without several.
"""

from __future__ import annotations

import ast
import contextlib
import csv
import gc
import importlib
import inspect
import io
import json
import os
import re
import select
import signal
import sys
import textwrap
import time
from collections import Counter
from pathlib import Path
from typing import Any, Callable, Dict, Iterable, Iterator, List, NamedTuple, Optional, Set, Tuple

__all__ = ["Checkout", "Part", "outcome", "parts", "table"]

Plan = Dict[str, Any]
PACKAGE = "legs_adapters"
CORPUS = Path(__file__).resolve().parents[1] / "docs/compatibility/corpus.csv"
KINDS = ("rule", "form", "reader", "words")
WORST_FIRST = ("wrong weight", "missed", "error")

# Attributes of the patcher, and what each returns where it is switched off. One that is gone is no part any more.
_OFF = {
    "form": {
        "PassedByName": {"terms.kinds.callback:Callbacks.assigned_in": []},
        "Registered": {"terms.kinds.callback:Callbacks.registered_in": []},
    },
    "reader": {
        "masks: rows": {"rules.verdict:is_rows": False},
        "error maps": {"rules.verdict:reads_of": ([], [])},
        "uses of a body": {"rules.verdict:uses_of": []},
        "doubts": {"rules.verdict:Verdicts.doubt": None},
        "purposes": {"rules.purpose:Purposes.purpose": None},
    },
}


class Part(NamedTuple):
    """A part of the patcher, with its lines of code."""

    kind: str
    name: str
    lines: int

    @property
    def key(self) -> str:
        return f"{self.kind}: {self.name}"


# -- the parts, as the code of the day lists them


def parts() -> List[Part]:
    """Return every part that can be switched off."""
    found = [Part("rule", name, sum(map(_lines, set(map(type, some))))) for name, some in rules().items()]
    found += [Part("form", kind.__name__, _lines(sys.modules[kind.__module__])) for kind in kinds_of_form()]
    for kind, table in _OFF.items():
        for name, targets in table.items():
            holders = [holder for holder in map(_holder, targets) if holder is not None]
            found += [Part(kind, name, sum(_lines(getattr(*holder)) for holder in holders))] if holders else []
    return found + [Part("words", name, _lines_of_list(name)) for name in lists()]


def rules() -> Dict[str, List[Any]]:
    """Return the rules of L1 terms by id."""
    order, base = _module("rules.order"), _module("rules.rule").Rule
    tuples = [value for name, value in vars(order).items() if isinstance(value, tuple) and name != "SSIM"]
    found: Dict[str, List[Any]] = {}
    for rule in {id(rule): rule for some in tuples for rule in some if isinstance(rule, base)}.values():
        if not type(rule).__module__.endswith(".ssim"):
            found.setdefault(rule.id, []).append(rule)
    return found


def kinds_of_form() -> List[Any]:
    """Return the forms that are found in a call by themselves."""
    return list(_module("terms.forms").KINDS)


def lists() -> Dict[str, Any]:
    """Return the lists of words by name: sets, patterns, and of a table of words each of its kinds."""
    _module("rules.find")  # which imports all that read the lists
    found: Dict[str, Any] = {}
    for name, value in vars(_module("lexicon.words")).items():
        if isinstance(value, (set, frozenset, re.Pattern)) and name != "SPEAKS_OF_L1":  # without it nothing is read
            found[name] = value
        elif isinstance(value, dict) and not name.startswith("__"):
            found.update({f"{name}[{kind}]": value for kind in dict.fromkeys(value.values())})
    return {name: value for name, value in found.items() if next(_holders(value), None) is not None}


def _words_of(name: str, value: Any) -> Set[str]:
    if isinstance(value, dict):
        return {word for word, kind in value.items() if name.endswith(f"[{kind}]")}
    return set() if isinstance(value, re.Pattern) else set(value)


def _holders(value: Any) -> Iterator[Tuple[Any, str]]:
    """Yield the modules that import a value from the lexicon, each with the name it has there."""
    for name, module in list(sys.modules.items()):
        if name.startswith(f"{PACKAGE}.") and not name.endswith(".words"):
            yield from ((module, attribute) for attribute, held in list(vars(module).items()) if held is value)


def _module(name: str) -> Any:
    return importlib.import_module(f"{PACKAGE}.{name}")


def _holder(path: str) -> Optional[Tuple[Any, str]]:
    """Return what holds ``module:Class.method``, and the last name; None where it is gone."""
    module, _, names = path.partition(":")
    *owners, last = names.split(".")
    try:
        holder = _module(module)
        for owner in owners:
            holder = getattr(holder, owner)
        getattr(holder, last)
    except (ImportError, AttributeError):
        return None
    return holder, last


def _lines(thing: Any) -> int:
    """Return the lines of code of a module, a class or a function: no docstrings, comments, imports, blank lines."""
    text = textwrap.dedent(inspect.getsource(thing))
    left: Set[int] = set()
    for node in ast.walk(ast.parse(text)):
        body = getattr(node, "body", ())
        is_documented = isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)) and ast.get_docstring(node)
        for part in [body[0]] if is_documented else [node] if isinstance(node, (ast.Import, ast.ImportFrom)) else []:
            left.update(range(part.lineno, (part.end_lineno or part.lineno) + 1))
    code = [line.strip() for i, line in enumerate(text.splitlines(), 1) if i not in left]
    return sum(1 for line in code if line and not line.startswith("#"))


def _lines_of_list(name: str) -> int:
    tree = ast.parse(inspect.getsource(_module("lexicon.words")))
    for node in tree.body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == name:
            return (node.end_lineno or node.lineno) - node.lineno + 1
    return 1


# -- switching off


def switch_off(kind: str, name: str) -> None:
    """Let a part behave as if it did not exist, from now on: fork first."""
    if kind == "rule":
        for rule in rules()[name]:
            rule.evidence = lambda *_: []
    elif kind == "words":
        _replace(lists()[name], _without(name))
    elif name in _OFF.get(kind, ()):
        for path, answer in _OFF[kind][name].items():
            holder = _holder(path)
            if holder is not None:
                setattr(*holder, lambda *_, answer=answer, **__: answer)
    else:
        others = [form for form in kinds_of_form() if form.__name__ != name]
        _module("terms.forms").KINDS = others


def _without(name: str) -> Any:
    value = lists()[name]
    if isinstance(value, dict):
        return {word: kind for word, kind in value.items() if not name.endswith(f"[{kind}]")}
    return re.compile(r"(?!)") if isinstance(value, re.Pattern) else frozenset()


def _replace(value: Any, instead: Any) -> None:
    for module, attribute in list(_holders(value)):
        setattr(module, attribute, instead)


# -- which parts have a say in a plan


class _Words:
    """A list of words that notes which of them an identifier contains. It is no set: ``words & this`` asks it."""

    def __init__(self, words: Iterable[str], *notes: Set[str]) -> None:
        self._words, self._notes = frozenset(words), notes

    def _note(self, words: Iterable[Any]) -> Any:
        found = self._words.intersection(words)
        for noted in self._notes:
            noted.update(found)
        return found

    def __contains__(self, word: object) -> bool:
        return bool(self._note([word]))

    def __and__(self, other: Iterable[Any]) -> Any:
        return self._note(other)

    __rand__ = intersection = __and__

    def isdisjoint(self, other: Iterable[Any]) -> bool:
        return not self._note(other)

    def __rsub__(self, other: Any) -> Any:
        return other - self._note(other)

    def __iter__(self) -> Iterator[str]:
        return iter(self._note(self._words))

    def __or__(self, other: Any) -> _Words:
        return _Words(self._words.union(other), *self._notes, *getattr(other, "_notes", ()))

    __ror__ = __or__


class _Table(Dict[str, str]):
    """A table of words that notes which of them an identifier contains."""

    def __init__(self, words: Dict[str, str], noted: Set[str]) -> None:
        super().__init__(words)
        self._noted = noted

    def __contains__(self, word: object) -> bool:
        found = super().__contains__(word)
        self._noted.update([str(word)] if found else [])
        return found


class _Pattern:
    """A pattern that notes whether a text contains it."""

    def __init__(self, pattern: Any, noted: Set[str]) -> None:
        self._pattern, self._noted, self.pattern = pattern, noted, pattern.pattern

    def search(self, *given: Any) -> Any:
        found = self._pattern.search(*given)
        self._noted.update([found.group()] if found else [])
        return found


def listen() -> Callable[[], Set[str]]:
    """Note from now on which parts have a say; return a function that returns their keys."""
    noted: Dict[str, Set[str]] = {}
    words: Dict[str, Set[str]] = {}
    for name, some in rules().items():
        for rule in some:
            _listen_to(rule, "evidence", noted.setdefault(f"rule: {name}", set()))
    for form in kinds_of_form():
        _listen_to(form, "find", noted.setdefault(f"form: {form.__name__}", set()))
    for kind, table in _OFF.items():
        for name, targets in table.items():
            for holder in filter(None, map(_holder, targets)):
                _listen_to(*holder, noted.setdefault(f"{kind}: {name}", set()))
    tables: Dict[int, Set[str]] = {}
    for name, value in lists().items():
        key = f"words: {name}"
        words[key] = _words_of(name, value)
        if isinstance(value, dict):
            noted[key] = tables[id(value)] = tables.get(id(value), set())
        else:
            noted[key] = set()
            new = _Pattern(value, noted[key]) if isinstance(value, re.Pattern) else _Words(value, noted[key])
            _replace(value, new)
    for value in [value for value in lists().values() if id(value) in tables]:
        _replace(value, _Table(value, tables[id(value)]))
    return lambda: {key for key, said in noted.items() if (said & words[key] if words.get(key) else said)}


def _listen_to(holder: Any, name: str, noted: Set[str]) -> None:
    work = getattr(holder, name)

    def heard(*given: Any, **named: Any) -> Any:
        answer = work(*given, **named)
        answer = list(answer) if inspect.isgenerator(answer) else answer
        noted.update(["said"] if answer else [])
        return answer

    setattr(holder, name, heard)


# -- one checkout


class Checkout:
    """A checkout that is parsed once and planned many times, in a process of its own.

    Args:
        folder: the checkout.
        limit: seconds for all of it; parts that are not reached are reported as such.
    """

    def __init__(self, folder: str, limit: float) -> None:
        self._folder, self._end = folder, time.monotonic() + limit
        self._reuse_parsed()
        self.plan = plan_of(folder)
        gc.collect()
        gc.freeze()  # a forked copy shares what the collector does not touch

    def _reuse_parsed(self) -> None:
        """Let later plans use the files and syntax trees of the first; what rules do not decide is kept, too."""
        planning, finding = _module("plan"), _module("rules.find")
        read, analyse, made = planning.read_files, finding.Analysis, {}
        self._anew = False

        def read_once(*given: Any) -> Any:
            return made["files"] if "files" in made else made.setdefault("files", read(*given))

        def analyse_once(*given: Any) -> Any:
            if "analysis" not in made:
                made["analysis"] = analyse(*given)
            return analyse(made["analysis"].program) if self._anew else made["analysis"]

        planning.read_files, finding.Analysis = read_once, analyse_once

    def ablate(self) -> Dict[str, Any]:
        """Return the plan, the parts that have a say, the plans that differ without one, and what was not reached."""
        spoken = self._forked(self._listening)
        without: Dict[str, Plan] = {}
        left: List[str] = [] if isinstance(spoken, list) else ["all parts"]
        for key in spoken if isinstance(spoken, list) else ():
            plan = self._forked(lambda key=key: self._without(key))
            if not isinstance(plan, dict):
                left.append(key)
            elif plan != self.plan:
                without[key] = plan
        return {"plan": self.plan, "spoken": spoken or [], "without": without, "left": left}

    def _listening(self) -> List[str]:
        self._anew = True
        spoken = listen()
        if plan_of(self._folder) != self.plan:
            raise AssertionError("a second plan of the same checkout is another one")
        return sorted(spoken())

    def _without(self, key: str) -> Plan:
        kind, _, name = key.partition(": ")
        self._anew = kind != "rule"
        switch_off(kind, name)
        return plan_of(self._folder)

    def _forked(self, work: Callable[[], Any]) -> Any:
        """Return what a forked copy of this process answers; None if it fails or the time is up."""
        here, there = os.pipe()
        child = os.fork()
        if child == 0:
            with contextlib.suppress(BaseException):  # without an answer, the part counts as not reached
                os.close(here)
                with os.fdopen(there, "w") as pipe:
                    json.dump(work(), pipe)
            os._exit(0)
        os.close(there)
        data = b""
        with os.fdopen(here, "rb", 0) as pipe:
            while select.select([pipe], [], [], max(0.0, self._end - time.monotonic()))[0]:
                piece = pipe.read(1 << 20)
                data += piece
                if not piece:
                    break
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        try:
            return json.loads(data)
        except ValueError:
            return None


def plan_of(folder: str, *options: str) -> Plan:
    """Return the report of ``legs-patch --check --json`` with these options, and the exit code."""
    from legs_adapters.cli import main as legs_patch

    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = legs_patch(["--check", "--json", *options, folder])
    try:
        found = json.loads(out.getvalue())
        found.pop("root", None)
    except ValueError:  # an error before there was a plan
        found = {"error": err.getvalue().replace(folder, "CHECKOUT").strip()}
    return {"exit": code, **found}


# -- all checkouts


def outcome(truth: Plan, plan: Plan) -> Optional[str]:
    """Return what is worse in a plan than in one that was judged right, the gravest word; None where nothing is."""

    def lines(of: Plan, *keys: str) -> Set[Tuple[str, int]]:
        return {(entry["file"], entry["line"]) for key in keys for entry in of.get(key, ())}

    due, weighted = lines(truth, "sites"), lines(plan, "sites")
    quoted = lines(plan, "problems", "doubts")
    if weighted - due:
        return "wrong weight"
    if (due | lines(truth, "problems")) - weighted - quoted:
        return "missed"
    if due - weighted or lines(plan, "problems") - lines(truth, "problems") or plan.get("error") != truth.get("error"):
        return "error"
    return None


def table(truth: Dict[str, Plan], ablated: Dict[str, Dict[str, Any]]) -> str:
    """Return the table of parts as Markdown: those that decide in the most checkouts first, in each kind."""
    with CORPUS.open(encoding="utf-8", newline="") as file:
        known = {row["codebase"].replace("/", "+", 1) for row in csv.DictReader(file) if row["known"]}
    finished = {name: found for name, found in ablated.items() if "plan" in found}
    rows: List[Tuple[int, Part, str]] = []
    for part in parts():
        said = {name: _worse(truth, name, found, part.key) for name, found in finished.items()}
        words = {name: word for name, word in said.items() if word is not None}
        spoke = sum(part.key in found["spoken"] for found in finished.values())
        how = Counter(words.values())
        cells = [
            f"{part.kind} `{part.name}`",
            str(part.lines),
            str(spoke),
            str(len(words)),
            str(len(known.intersection(words))),
            ", ".join(f"{word} {how[word]}" for word in WORST_FIRST if word in how),
            " ".join(sorted(words, key=lambda name: (name not in known, name))),
        ]
        rows.append((len(words), part, f"| {' | '.join(cells)} |"))
    rows.sort(key=lambda row: (KINDS.index(row[1].kind), -row[0], row[1].name))
    head = "| part | lines | has a say in | differs without it in | well known | how | checkouts |"
    left = [
        f"Not finished: {name}: {', '.join(found.get('left', [found.get('error', '')]))}"
        for name, found in ablated.items()
        if found.get("left", True)
    ]
    return "\n".join([head, "| --- " * 7 + "|", *(row for *_, row in rows), *left])


def _worse(truth: Dict[str, Plan], name: str, found: Dict[str, Any], key: str) -> Optional[str]:
    """Return what is worse in a checkout's plan without a part; None where that plan is as good as with it."""
    if key not in found["without"]:
        return None
    judged = truth.get(name, found["plan"])
    said = outcome(judged, found["without"][key])
    return said if said != outcome(judged, found["plan"]) else None
