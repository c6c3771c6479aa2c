"""Find where the line goes that hides masked pixels from every term of a training step.

It goes where rendering and photograph are both defined, before any term gets the rendering. Where a term gets the
rendering by another way, or no such place is in the function of the L1, the line is an error, to be written by hand.
What else compares the two there may be a mean over all pixels, masked ones too: each is named, with its correction.
"""

from __future__ import annotations

import re
from typing import Dict, Iterator, List, NamedTuple, Optional, Sequence, Tuple, Union

import libcst as cst

from legs_adapters.code.module import Function, blocks_of
from legs_adapters.code.reaching import Definition
from legs_adapters.code.syntax import (
    arguments,
    call_name,
    children,
    constant,
    every_parameter,
    one_line,
    path_of,
    walk_expressions,
)
from legs_adapters.lexicon.words import STRUCTURAL
from legs_adapters.rules.analysis import Analysis
from legs_adapters.terms.findings import Decider, Findings, Left, Problem, Site
from legs_adapters.terms.kinds.callback import PassedByName
from legs_adapters.terms.kinds.masked import Masked
from legs_adapters.terms.patched import patched_nodes
from legs_adapters.terms.writing import PACKAGE

__all__ = ["with_masks"]

_MASKED, _COVERAGE = f"{PACKAGE}.masked", f"{PACKAGE}.coverage"
_MOST = 100  # expressions that a rendering is followed through


def with_masks(found: Findings, analysis: Analysis) -> Findings:
    """Return findings with the lines that mask the renderings of their terms, and with those to be written by hand."""
    finder = _Finder(analysis)
    for site in found.sites:
        form = site.form
        sides = (form.second, form.first) if site.swapped else (form.first, form.second)
        whole = [side.value if site.selection and isinstance(side, cst.Subscript) else side for side in sides]
        pair = _Pair(site.scope, form.node, whole[0], whole[1])
        if isinstance(form, PassedByName):
            finder.problems.append(pair.problem(site.scope, form.node, "the L1 is called elsewhere"))
        elif form.weighs:
            finder.look_at(pair)
    for entry in found.patched:
        finder.look_at_patched(entry)
    lines, problems = finder.settled()
    left = [entry for line in lines for entry in finder.diluted(line, found.sites)]
    return found.with_more(sites=[line.site for line in lines], problems=problems, left=left)


class _Pair(NamedTuple):
    """The two images of a term, without the index by a mask that both carry; and the term, in its function."""

    function: Function
    node: cst.BaseExpression
    prediction: cst.BaseExpression
    target: cst.BaseExpression

    def form(self, after: Optional[cst.CSTNode] = None, before: Optional[cst.CSTNode] = None) -> Masked:
        """Return the line between two statements."""
        return Masked(self.node, cst.Call(self.prediction), self.prediction, self.target, after=after, before=before)

    def problem(self, function: Function, node: cst.CSTNode, why: str) -> Problem:
        """Return the line as one to be written by hand, with the expression that is the reason."""
        is_named = path_of(self.prediction) is not None and path_of(self.target) is not None
        line = self.form().line if is_named else "give both images names, and mask the rendering on a line of its own"
        advice = f"{line} before every term that gets the rendering"
        return Problem.at(function, function.place(node), f"not masked: {why}", advice)


class _Line(NamedTuple):
    """A line between two statements of a block, and the bytes that it covers: what follows it in the block."""

    pair: _Pair
    after: Optional[cst.CSTNode]
    before: cst.CSTNode
    start: int
    end: int

    def covers(self, function: Function, node: cst.CSTNode) -> bool:
        """Return whether a read is of its rendering, and comes after it."""
        is_same = function is self.pair.function and path_of(node) == path_of(self.pair.prediction)
        return is_same and self.start <= function.place(node).start < self.end

    @property
    def site(self) -> Site:
        """The line as an edit."""
        function, form = self.pair.function, self.pair.form(self.after, self.before)
        return Site.at(function, form, f"{form.line}, before line {function.place(self.before).line}")


class _Finder:
    def __init__(self, analysis: Analysis) -> None:
        self.analysis = analysis
        self.lines: List[_Line] = []
        self.unnamed: List[_Pair] = []
        self.problems: List[Problem] = []
        self._reads: Dict[Function, Dict[Optional[str], List[cst.CSTNode]]] = {}

    def look_at_patched(self, entry: Left) -> None:
        """Take in the terms of a line that were weighted before."""
        module = self.analysis.program.module(entry.path)
        for function in module.scopes(lambda text: PACKAGE in text) if module is not None else ():
            weighted = patched_nodes(self.analysis.program, function, (f"{PACKAGE}.l1_loss",))
            for call in function.flow.calls:
                sides = arguments(call)[0]
                if call.func in weighted and function.place(call.func).line == entry.line and len(sides) >= 2:
                    self.look_at(_Pair(function, call, sides[0], sides[1]))

    def look_at(self, pair: _Pair) -> None:
        """Take in a term: the line of its rendering, or a problem."""
        made = pair.function.flow.value_of(pair.prediction)
        resolve = self.analysis.program.resolve
        if isinstance(made, cst.Call) and any(r.target == _MASKED for r in resolve(pair.function, made.func)):
            return  # written before
        if not isinstance(pair.prediction, cst.Name):
            self.unnamed.append(pair)
            return
        line = _line(pair)
        if isinstance(line, str):
            self.problems.append(pair.problem(pair.function, pair.node, line))
        elif not any(one.start == line.start and one.covers(pair.function, pair.prediction) for one in self.lines):
            self.lines.append(line)

    def diluted(self, line: _Line, sites: Sequence[Site]) -> Iterator[Left]:
        """Yield the calls that get both images of a line after it, and are no terms of ours."""
        function, resolve = line.pair.function, self.analysis.program.resolve
        pair = {path_of(line.pair.prediction), path_of(line.pair.target)}
        edited = [function.place(site.form.node) for site in sites if site.scope is function]
        for call in function.flow.calls:
            place, given = function.place(call), arguments(call)[0]
            images = [{path_of(part) for part in _places(each)} & pair for each in given]
            if set().union(*images) != pair or not self.analysis.training.includes(call):
                continue
            own = any(str(r.target).startswith(f"{PACKAGE}.") for r in resolve(function, call.func))
            inside = any(at.start < place.end and place.start < at.end for at in edited)
            if own or inside or any(both == pair for both in images) or not line.start <= place.start < line.end:
                continue
            term, share = one_line(call), f"{_COVERAGE}({one_line(line.pair.prediction)}, {one_line(line.pair.target)})"
            is_similarity = STRUCTURAL.search(term) and not re.search("(?i)loss", call_name(call))
            corrected = f"(1.0 - (1.0 - {term}) / {share})" if is_similarity else f"{term} / {share}"
            yield Left.at(function, place, f"diluted by masked pixels if it is a mean over all; write {corrected}")

    def settled(self) -> Tuple[List[_Line], List[Problem]]:
        """Return the lines that mask every term, and the problems; where one is not written, others may leak."""
        for line in self.lines:
            leak = self._leak(line.pair)
            if leak is not None:
                self.lines.remove(line)
                why = f"{one_line(leak[1])} reaches the loss here, past the mask"
                self.problems.append(line.pair.problem(*leak, why))
                return self.settled()
        for pair in self.unnamed:  # image * alpha is masked where image is
            if self._leak(pair) is not None:
                self.problems.append(pair.problem(pair.function, pair.node, "the rendering has no name"))
        return self.lines, list(dict.fromkeys(self.problems))

    def _leak(self, pair: _Pair) -> Optional[Decider]:
        """Return a read that takes what a rendering is made of into the loss, and comes after no line."""
        work: List[Tuple[Function, cst.CSTNode]] = [(pair.function, pair.prediction)]
        found: List[Tuple[Function, cst.CSTNode]]
        carriers: List[Decider] = []
        for where, node in work:  # which grows
            for part in _places(node):
                meaning = self.analysis.meanings.meaning(where, part)
                if part is not pair.prediction and not (meaning.kind == "image" and meaning.role in ("render", "both")):
                    continue
                carriers.append((where, part))
                reaching = where.flow.reaching(part) if len(work) < _MOST else ()
                where.module.spend(len(reaching))
                for made in reaching:
                    if made.kind == "parameter":
                        calls = self.analysis.training.sites.get(where, ())
                        given = [(caller, where.given(call, made.place)) for caller, call in calls]
                        found = [(caller, value) for caller, value in given if value is not None]
                    else:
                        value = made.node if made.kind == "augment" else made.value
                        found = [(where, value)] if value is not None and made.kind != "import" else []
                    work += [entry for entry in found if entry not in work]
        spans = [(where, where.place(node)) for where, node in work[1:]]
        for function, carrier in carriers:
            for read in self._others(function, carrier):
                at = function.place(read).start
                inside = any(where is function and span.start <= at < span.end for where, span in spans)
                if not inside and not any(line.covers(function, read) for line in self.lines):
                    return function, read
        return None

    def _others(self, function: Function, carrier: cst.CSTNode) -> Iterator[cst.CSTNode]:
        """Yield the reads of the same value, or of the whole of it, that a backward pass reaches."""
        training = self.analysis.training
        if function not in self._reads:
            self._reads[function] = {}
            for read in _places(function.body):
                if training.includes(read) or not training.touches(function):
                    self._reads[function].setdefault(path_of(read), []).append(read)
        for read in self._reads[function].get(path_of(carrier), ()):
            if function.module.spend(1):
                yield read


def _line(pair: _Pair) -> Union[_Line, str]:
    """Return the line, in the outermost block in which both images are defined before the term; or why not."""
    function, reaching = pair.function, pair.function.flow.reaching
    parts = [part for side in (pair.prediction, pair.target) for part in walk_expressions(side)]
    if not reaching(pair.prediction) or any(isinstance(part, cst.Call) for part in parts):
        return "the images have no names here"
    header = list(every_parameter(function.node.params)) if isinstance(function.node, cst.FunctionDef) else []
    made = [[d for d in reaching(part) if d.node not in header] for part in parts]
    starts = [function.place(d.node).start for definitions in made for d in definitions]
    names = [(part, ds) for part, ds in zip(parts, made) if isinstance(part, cst.Name)]
    unbound = [ds for name, ds in names if ds and len(ds) == len(reaching(name))]
    for block, index in _blocks_around(function, pair.node):
        places = [function.place(statement) for statement in block]
        here = any(places[index].start <= start for start in starts)
        earlier = [i for i in range(index) if any(places[i].start <= start for start in starts)]
        after = index - 1 if here or not earlier else earlier[-1]
        unbound = [ds for ds in unbound if not any(_binds(function, each, ds) for each in block[: after + 1])]
        if not here and not unbound:
            before = block[after + 1]
            return _Line(pair, block[after] if after >= 0 else None, before, places[after + 1].start, places[-1].end)
    return "no line before the term surely comes after both images"


def _binds(function: Function, node: cst.CSTNode, made: Sequence[Definition]) -> bool:
    """Return whether a statement makes one of these definitions, in each of its branches."""
    if isinstance(node, (cst.If, cst.Else, cst.With)):
        inside = any(_binds(function, statement, made) for statement in node.body.body)
        other = node.orelse if isinstance(node, cst.If) else node
        return inside and other is not None and (other is node or _binds(function, other, made))
    span = function.place(node)
    is_line = isinstance(node, cst.SimpleStatementLine)
    return is_line and any(span.start <= function.place(d.node).start < span.end for d in made)


def _blocks_around(function: Function, node: cst.CSTNode) -> Iterator[Tuple[Sequence[cst.CSTNode], int]]:
    """Yield the blocks around a node, the outermost first, each with the index of the statement around it."""
    start = function.place(node).start
    blocks: List[Sequence[cst.CSTNode]] = [function.body.body]
    while blocks:
        found = [
            (block, i)
            for block in blocks
            for i, statement in enumerate(block)
            if not isinstance(statement, cst.BaseSmallStatement)  # on the line of its if
            and function.place(statement).start <= start < function.place(statement).end
        ]
        yield from found
        blocks = [inner for block, i in found for inner in blocks_of(block[i])]


def _places(node: cst.CSTNode) -> Iterator[cst.CSTNode]:
    """Yield the places that are read in a node, ``pkg['render']`` and not the ``pkg`` in it, but for depth channels."""
    stack = [node]
    while stack:
        part = stack.pop()
        if path_of(part) is not None:
            yield part
        elif isinstance(part, cst.Call):
            stack += [arg.value for arg in part.args]
            stack.append(part.func.value if isinstance(part.func, cst.Attribute) else part.func)
        elif not isinstance(part, (cst.FunctionDef, cst.ClassDef)) and not _is_past_colours(part):
            stack += children(part)


def _is_past_colours(node: cst.CSTNode) -> bool:
    """Return whether an index takes other channels than the first three of a rendering: ``package[3:6]``."""
    if not isinstance(node, cst.Subscript):
        return False
    indices = [each.slice for each in node.slice]
    firsts = [constant(i.lower if isinstance(i, cst.Slice) else i.value) for i in indices]  # type: ignore[attr-defined]
    return any(isinstance(first, int) and first >= 3 for first in firsts)
