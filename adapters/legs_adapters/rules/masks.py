"""Find where the line goes that hides masked pixels from every term of a training step.

It goes where rendering and photograph are both defined, before any term gets the rendering. Where a term gets the
rendering by another way, or no such place is in the function of the L1, the line is an error, to be written by hand.
What else compares the two there may be a mean over all pixels, masked ones too: each is named, with its correction.
"""

from __future__ import annotations

import ast
import bisect
import math
import re
from typing import Dict, Iterator, List, NamedTuple, Optional, Sequence, Set, Tuple, Union

from legs_adapters.code.limits import remembered
from legs_adapters.code.module import Function, blocks_of
from legs_adapters.code.parsing import Lines, Place
from legs_adapters.code.reaching import Reaching
from legs_adapters.code.syntax import (
    FUNCTIONS,
    arguments,
    call_name,
    children,
    given,
    one_line,
    path_of,
    walk_expressions,
)
from legs_adapters.lexicon.depiction import is_fourth
from legs_adapters.lexicon.words import STRUCTURAL
from legs_adapters.rules.analysis import Analysis
from legs_adapters.terms.findings import Decider, Findings, Left, Problem, Site
from legs_adapters.terms.kinds.callback import PassedByName
from legs_adapters.terms.kinds.masked import Masked
from legs_adapters.terms.patched import patched_nodes
from legs_adapters.terms.writing import PACKAGE

_MASKED, _COVERAGE = f"{PACKAGE}.masked", f"{PACKAGE}.coverage"
_Given = Tuple[ast.Call, List[Set[Optional[str]]]]  # a call, and what its arguments read

_MOST = 100  # expressions that a rendering is followed through


def with_masks(found: Findings, analysis: Analysis) -> Findings:
    """Return findings with the lines that mask the renderings of their terms, and with those to be written by hand."""
    masking = _MaskLines(analysis)
    for site in found.sites:
        form = site.form
        sides = (form.second, form.first) if site.swapped else (form.first, form.second)
        whole = [side.value if site.selection and isinstance(side, ast.Subscript) else side for side in sides]
        pair = _ImagePair(site.scope, form.node, whole[0], whole[1])
        if isinstance(form, PassedByName):
            masking.problems.append(pair.problem(site.scope, form.node, "the L1 is called elsewhere"))
        elif not form.term:
            masking.look_at(pair)
    for entry in found.patched:
        masking.look_at_patched(entry)
    lines, problems = masking.settled()
    edited = {id(part) for site in found.sites for part in walk_expressions(site.form.node)}
    left = [entry for line in lines for entry in masking.diluted(line, edited)]
    return found.with_more(sites=[line.site for line in lines], problems=problems, left=left)


class _ImagePair(NamedTuple):
    """The two images of a term, without the index by a mask that both carry; and the term, in its function."""

    function: Function
    node: ast.expr
    prediction: ast.expr
    target: ast.expr

    def form(self, after: Optional[ast.AST] = None, before: Optional[ast.AST] = None) -> Masked:
        """Return the line between two statements."""
        call = ast.Call(self.prediction, [], [])
        return Masked(self.node, call, self.prediction, self.target, after=after, before=before)

    def problem(self, function: Function, node: ast.AST, why: str) -> Problem:
        """Return the line as one to be written by hand, with the expression that is the reason."""
        is_named = path_of(self.prediction) is not None and path_of(self.target) is not None
        line = self.form().line if is_named else "give both images names, and mask the rendering on a line of its own"
        advice = f"{line} before every term that gets the rendering"
        return Problem.at(function, function.place(node), f"not masked: {why}", advice)


class _MaskLine(NamedTuple):
    """A line between two statements of a block, and the bytes that it covers: what follows it in the block."""

    pair: _ImagePair
    form: Masked
    start: int
    end: int

    @property
    def place(self) -> Tuple[Function, Optional[str]]:
        """The function and the place of the rendering."""
        return self.pair.function, path_of(self.pair.prediction)

    def covers(self, node: ast.AST) -> bool:
        """Return whether a node of its function comes after it, in its block."""
        return self.start <= self.pair.function.place(node).start < self.end

    @property
    def site(self) -> Site:
        """The line as an edit."""
        function, before = self.pair.function, self.form.before
        assert before is not None
        return Site.at(function, self.form, f"{self.form.line}, before line {function.place(before).line}")


class _MaskLines:
    def __init__(self, analysis: Analysis) -> None:
        self.analysis = analysis
        self.lines: Dict[Tuple[Function, Optional[str]], List[_MaskLine]] = {}  # by the rendering's function and place
        self.unnamed: List[_ImagePair] = []
        self.problems: List[Problem] = []

    def look_at_patched(self, entry: Left) -> None:
        """Take in the terms of a line that were weighted before."""
        module = self.analysis.program.module(entry.path)
        for function in module.scopes(lambda text: PACKAGE in text) if module is not None else ():
            weighted = patched_nodes(self.analysis.program, function, (f"{PACKAGE}.l1_loss",))
            for call in function.flow.calls:
                sides = arguments(call)[0]
                if call.func in weighted and function.place(call.func).line == entry.line and len(sides) >= 2:
                    self.look_at(_ImagePair(function, call, sides[0], sides[1]))

    def look_at(self, pair: _ImagePair) -> None:
        """Take in a term: the line of its rendering, or a problem."""
        made = pair.function.flow.value_of(pair.prediction)
        resolve = self.analysis.program.resolve
        if isinstance(made, ast.Call) and any(r.target == _MASKED for r in resolve(pair.function, made.func)):
            return  # written before
        if not isinstance(pair.prediction, ast.Name):
            self.unnamed.append(pair)
            return
        line = self._line(pair)
        if isinstance(line, str):
            self.problems.append(pair.problem(pair.function, pair.node, line))
        else:
            known = self.lines.setdefault(line.place, [])
            covered = any(one.start == line.start and one.covers(pair.prediction) for one in known)
            known += [] if covered else [line]

    def diluted(self, line: _MaskLine, edited: Set[int]) -> Iterator[Left]:
        """Yield the calls that get both images of a line after it, and are no terms of ours: not in what is edited."""
        function, resolve = line.pair.function, self.analysis.program.resolve
        pair = {path_of(line.pair.prediction), path_of(line.pair.target)}
        for call, images in self._calls(function).get(path_of(line.pair.prediction), ()):
            place = function.place(call)
            if not pair <= set().union(*images) or any(pair <= both for both in images) or id(call) in edited:
                continue
            own = any(str(r.target).startswith(f"{PACKAGE}.") for r in resolve(function, call.func))
            if own or not line.covers(call):
                continue
            term, share = one_line(call), f"{_COVERAGE}({one_line(line.pair.prediction)}, {one_line(line.pair.target)})"
            is_similarity = STRUCTURAL.search(term) and not re.search("(?i)loss", call_name(call))
            corrected = f"(1.0 - (1.0 - {term}) / {share})" if is_similarity else f"{term} / {share}"
            yield Left.at(function, place, f"diluted by masked pixels if it is a mean over all; write {corrected}")

    def settled(self) -> Tuple[List[_MaskLine], List[Problem]]:
        """Return the lines that mask every term, and the problems; where one is not written, others may leak."""
        kept = [line for lines in self.lines.values() for line in lines]
        left = None
        while left != len(kept):
            left = len(kept)
            for line in list(kept):
                leak = self._leak(line.pair)
                if leak is not None:
                    kept.remove(line)
                    self.lines[line.place].remove(line)
                    why = f"{one_line(leak[1])} reaches the loss here, past the mask"
                    self.problems.append(line.pair.problem(*leak, why))
        for pair in self.unnamed:  # image * alpha is masked where image is
            if self._leak(pair) is not None:
                self.problems.append(pair.problem(pair.function, pair.node, "the rendering has no name"))
        return kept, list(dict.fromkeys(self.problems))

    def _leak(self, pair: _ImagePair) -> Optional[Decider]:
        """Return a read that takes what a rendering is made of into the loss, and comes after no line."""
        work: List[Tuple[Function, ast.AST]] = [(pair.function, pair.prediction)]
        found: List[Tuple[Function, Optional[ast.AST]]]
        carriers: Dict[Tuple[Function, Optional[str]], None] = {}
        made_of: Set[int] = set()
        met: Set[Reaching] = set()
        for where, node in work:  # which grows
            for part in _places(node):
                meaning = self.analysis.meanings.meaning(where, part)
                if part is not pair.prediction and not (meaning.kind == "image" and meaning.role in ("render", "both")):
                    continue
                carriers[where, path_of(part)] = None
                for made in where.flow.reaching(part).new(met) if len(work) < _MOST else ():
                    found = [(where, made.node if made.kind == "augment" else made.value)]
                    if made.kind == "parameter":
                        calls = self.analysis.training.sites.get(where, ())
                        found = [(caller, where.given(call, made.place)) for caller, call in calls]
                    for source, value in found if made.kind != "import" else ():
                        if value not in (None, pair.prediction) and id(value) not in made_of:
                            work.append((source, value))
                            made_of.update(map(id, walk_expressions(value)))
        pair.function.module.spend(len(met) + len(made_of))
        for function, place in carriers:
            lines = self.lines.get((function, place), ())
            for read in filter(lambda _: function.module.spend(1), self._reads(function).get(place, ())):
                if id(read) not in made_of and not any(line.covers(read) for line in lines):
                    return function, read
        return None

    @remembered
    def _reads(self, function: Function) -> Dict[Optional[str], List[ast.AST]]:
        """Return the reads of a function that a backward pass reaches, by their places."""
        training = self.analysis.training
        found: Dict[Optional[str], List[ast.AST]] = {}
        for read in _places(*function.body):
            if training.includes(read) or not training.touches(function):
                found.setdefault(path_of(read), []).append(read)
        return found

    @remembered
    def _calls(self, function: Function) -> Dict[Optional[str], List[_Given]]:
        """Return the trained calls of a function, by each place that they are given, with the places in arguments."""
        found: Dict[Optional[str], List[_Given]] = {}
        for call in filter(self.analysis.training.includes, function.flow.calls):
            read = [{path_of(part) for part in _places(each)} for each in arguments(call)[0]]
            for path in set().union(*read) if function.module.spend(1 + sum(map(len, read))) else ():
                found.setdefault(path, []).append((call, read))
        return found

    def _line(self, pair: _ImagePair) -> Union[_MaskLine, str]:
        """Return the line, in the outermost block in which both images are defined before the term; or why not."""
        function, reaching = pair.function, pair.function.flow.reaching
        parts = [part for side in (pair.prediction, pair.target) for part in walk_expressions(side)]
        if not reaching(pair.prediction) or any(isinstance(part, ast.Call) for part in parts):
            return "the images have no names here"
        made = [list(reaching(part)) for part in parts]
        starts = [[function.place(each.node).start for each in some if each.kind != "parameter"] for some in made]
        last = max((start for some in starts for start in some), default=-1)
        names = [(some, at) for part, some, at in zip(parts, made, starts) if isinstance(part, ast.Name)]
        unbound = [at for some, at in names if at and len(at) == len(some)]
        function.module.spend(sum(map(len, starts)))
        for block, places, index in _blocks_around(function, pair.node):
            here, earlier = places[index].start <= last, _last_before(places, last)
            after = index - 1 if here or earlier < 0 else earlier
            before = block[: after + 1]
            unbound = [some for some in unbound if not any(_binds(function, each, some) for each in before)]
            if not here and not unbound and _begins_line(function.module.lines, places[after + 1]):
                form = pair.form(block[after] if after >= 0 else None, block[after + 1])
                return _MaskLine(pair, form, places[after + 1].start, places[-1].end)
        return "no line before the term surely comes after both images"


def _binds(function: Function, node: ast.stmt, starts: Sequence[int]) -> bool:
    """Return whether a statement makes one of the definitions that begin there, in each of its branches."""
    place = function.place(node)
    inside = [at for at in starts if place.start <= at < place.end]
    if inside and isinstance(node, (ast.If, ast.With, ast.AsyncWith)):
        branches = [node.body, node.orelse] if isinstance(node, ast.If) else [node.body]
        return all(any(_binds(function, each, inside) for each in branch) for branch in branches)
    return bool(inside) and not any(blocks_of(node))


def _blocks_around(function: Function, node: ast.AST) -> Iterator[Tuple[List[ast.stmt], List[Place], int]]:
    """Yield the blocks around a node, the outermost first, with their places and the index of the statement around."""
    start = function.place(node).start
    blocks: List[List[ast.stmt]] = [function.body]
    for block in blocks:  # which grows
        places = [function.place(statement) for statement in block]
        index = _last_before(places, start)
        if index >= 0 and start < places[index].end:
            yield block, places, index
            blocks += blocks_of(block[index])


def _begins_line(lines: Lines, place: Place) -> bool:
    """Return whether a statement is the first thing on its line, and that line no continued one."""
    is_continued = place.line > 1 and lines.text(place.line - 1).endswith("\\")
    return not is_continued and not lines.data[lines.start(place.line) : place.start].strip()


def _last_before(places: Sequence[Place], at: int) -> int:
    """Return the index of the last that begins at a byte or before it; -1 without."""
    return bisect.bisect_right(places, (at, math.inf)) - 1


def _places(*nodes: ast.AST) -> Iterator[ast.AST]:
    """Yield the places that are read in nodes, ``pkg['render']`` and not the ``pkg`` in it, but for depth channels."""
    stack = list(nodes)
    while stack:
        part = stack.pop()
        if path_of(part) is not None:
            yield part
        elif isinstance(part, ast.Call):
            stack += [arg.value for arg in given(part)]
            stack.append(part.func.value if isinstance(part.func, ast.Attribute) else part.func)
        elif not isinstance(part, (*FUNCTIONS, ast.ClassDef)) and not is_fourth(part):
            stack += children(part)
