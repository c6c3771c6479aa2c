"""Find where the line goes that hides masked pixels from every term of a training step.

It goes where rendering and photograph are both defined, before any term gets the rendering. Where a term gets the
rendering by another way, or no such place is in the function of the L1, the line is an error, to be written by hand.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Dict, FrozenSet, Iterator, List, NamedTuple, Optional, Sequence, Tuple, Union

import libcst as cst

from legs_adapters.code.module import Function, blocks_of
from legs_adapters.code.reaching import Definition
from legs_adapters.code.syntax import (
    arguments,
    children,
    constant,
    every_parameter,
    one_line,
    path_of,
    walk_expressions,
    words,
)
from legs_adapters.lexicon.words import SIDES
from legs_adapters.rules.analysis import Analysis
from legs_adapters.terms.findings import Findings, Left, Problem, Site
from legs_adapters.terms.form import Form
from legs_adapters.terms.kinds.callback import PassedByName
from legs_adapters.terms.kinds.masked import Masked
from legs_adapters.terms.patched import patched_nodes
from legs_adapters.terms.writing import PACKAGE

__all__ = ["with_masks"]

_MASKED = f"{PACKAGE}.masked"
_MOST = 100  # expressions that a rendering is followed through
_ALL = (0, math.inf)
_LEAVES = (cst.Return, cst.Continue, cst.Break, cst.Raise)


def with_masks(found: Findings, analysis: Analysis) -> Findings:
    """Return findings with the lines that mask the renderings of their terms, and with those to be written by hand."""
    finder = _Finder(analysis)
    for site in found.sites:
        form = site.form
        sides = (form.second, form.first) if site.swapped else (form.first, form.second)
        whole = [side.value if site.selection and isinstance(side, cst.Subscript) else side for side in sides]
        if isinstance(form, PassedByName) and not _calls(site.scope, form):
            pair = _Pair(site.scope, form.node, whole[0], whole[1])
            finder.problems.append(pair.problem(site.scope, form.node, "the L1 is called elsewhere"))
        elif form.weighs:
            node = form.call if isinstance(form, PassedByName) else form.node
            finder.look_at(_Pair(site.scope, node, whole[0], whole[1]))
    for entry in found.patched:
        finder.look_at_patched(entry)
    sites, problems = finder.settled()
    return found._replace(
        sites=sorted([*found.sites, *sites], key=_where), problems=sorted([*found.problems, *problems], key=_where)
    )


def _where(entry: Union[Site, Problem]) -> Tuple[str, int]:
    return entry.path, entry.line


class _Pair(NamedTuple):
    """The two images of a term, without the index by a mask that both carry; and the term, in its function."""

    function: Function
    node: cst.BaseExpression
    prediction: cst.BaseExpression
    target: cst.BaseExpression

    @property
    def text(self) -> str:
        """The line to write."""
        name = one_line(self.prediction) if isinstance(self.prediction, cst.Name) else "image"
        return f"{name} = {_MASKED}({one_line(self.prediction)}, {one_line(self.target)})"

    def problem(self, function: Function, node: cst.CSTNode, why: str) -> Problem:
        """Return the line as one to be written by hand, with the expression that is the reason."""
        advice = f"{self.text} before every term that gets the rendering"
        return Problem.at(function, function.place(node), f"not masked: {why}", advice)


def _calls(function: Function, form: Form) -> bool:
    """Return whether a function calls the function of a form with the two images."""
    called = any(call is form.call for call in function.flow.calls)
    return called and any(part is form.first for part in walk_expressions(form.call))


@dataclass(frozen=True)
class _Read:
    """A read of a place in a function, and the index that it is taken with; None without."""

    function: Function
    node: cst.CSTNode
    index: Optional[cst.Subscript] = None


class _Line(NamedTuple):
    """A line, its function, and the bytes that it covers: what follows it in its block."""

    function: Function
    form: Masked
    start: int
    end: int

    def covers(self, read: _Read) -> bool:
        """Return whether a read is of its rendering, and comes after it."""
        named = read.function is self.function and path_of(read.node) == path_of(self.form.first)
        return named and self.start <= read.function.place(read.node).start < self.end


class _Finder:
    def __init__(self, analysis: Analysis) -> None:
        self.analysis = analysis
        self.lines: List[_Line] = []
        self.unnamed: List[_Pair] = []
        self.problems: List[Problem] = []
        self._reads: Dict[Function, List[_Read]] = {}

    def look_at_patched(self, entry: Left) -> None:
        """Take in the terms of a line that were weighted before."""
        module = self.analysis.program.module(entry.path)
        for function in module.scopes(lambda text: PACKAGE in text) if module is not None else ():
            weighted = patched_nodes(self.analysis.program, function, (f"{PACKAGE}.l1_loss",))
            for call in function.flow.calls:
                if call.func in weighted and function.place(call.func).line == entry.line:
                    positional, keywords, _ = arguments(call)
                    sides = [*positional, *(keywords[name] for name in ("prediction", "target") if name in keywords)]
                    if len(sides) >= 2:
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
        line = self._line(pair, pair.prediction)
        if isinstance(line, str):
            self.problems.append(pair.problem(pair.function, pair.node, line))
        elif all(
            (line.function, line.start) != (o.function, o.start) or not o.covers(_Read(line.function, pair.prediction))
            for o in self.lines
        ):
            self.lines.append(line)

    def settled(self) -> Tuple[List[Site], List[Problem]]:
        """Return the lines that mask every term, and the problems; where one is not written, others may leak."""
        leaks = True
        while leaks:
            leaks = False
            for line in list(self.lines):
                read = self._leak(line.function, line.form.first)
                if read is not None:
                    leaks = True
                    self.lines.remove(line)
                    pair = _Pair(line.function, line.form.node, line.form.first, line.form.second)
                    why = f"{one_line(read.node)} reaches the loss here, past the mask"
                    self.problems.append(pair.problem(read.function, read.node, why))
        for pair in self.unnamed:  # image * alpha is masked where image is
            read = self._leak(pair.function, pair.prediction)
            if read is not None:
                self.problems.append(pair.problem(pair.function, pair.node, "the rendering has no name"))
        return [_site(line) for line in self.lines], list(dict.fromkeys(self.problems))

    # -- the place

    def _line(self, pair: _Pair, prediction: cst.Name) -> Union[_Line, str]:
        """Return the line, in the outermost block in which both images are defined before the term; or why not."""
        function, flow = pair.function, pair.function.flow
        if not flow.reaching(prediction):
            return f"{prediction.value} is not assigned in {function.name or 'this file'}"
        if any(isinstance(part, cst.Call) for part in walk_expressions(pair.target)):
            return "the photograph has no name"
        header = function.node.params if isinstance(function.node, cst.FunctionDef) else cst.Parameters()
        parameters = {id(param) for param in every_parameter(header)}
        parts = [part for side in (prediction, pair.target) for part in walk_expressions(side)]
        made = [[d for d in flow.reaching(part) if id(d.node) not in parameters] for part in parts]
        starts = [function.place(d.node).start for definitions in made for d in definitions]
        names = [
            ds for part, ds in zip(parts, made) if isinstance(part, cst.Name) and len(ds) == len(flow.reaching(part))
        ]
        unbound = [ds for ds in names if ds]
        for statements, index in _blocks_around(function, pair.node):
            places = [function.place(statement) for statement in statements]
            if not isinstance(statements[index], (cst.SimpleStatementLine, cst.BaseCompoundStatement)):
                break  # on the line of its if
            if any(start >= places[index].end for start in starts):
                return "the images are changed after the term, in a loop"
            here = any(places[index].start <= start for start in starts)
            earlier = [
                i
                for i in range(index)
                if any(places[i].start <= start for start in starts) or _is_docstring(statements[i])
            ]
            after = max(earlier, default=-1)
            before = statements[: index if here else after + 1]
            unbound = [ds for ds in unbound if not any(_binds(function, statement, ds) for statement in before)]
            if not here and not unbound:
                sides = (prediction, pair.target)
                form = Masked(
                    pair.node,
                    cst.Call(prediction),
                    *sides,
                    after=statements[after] if after >= 0 else None,
                    before=statements[after + 1],
                )
                return _Line(function, form, places[after + 1].start, places[-1].end)
            inner = min((function.place(block[0]).start for block in blocks_of(statements[index]) if block), default=0)
            spans = range(places[index].start, inner)  # what the loop or with statement around the term binds
            unbound = [ds for ds in unbound if not any(function.place(d.node).start in spans for d in ds)]
        return "no line before the term surely comes after both images"

    # -- other ways into the loss

    def _leak(self, function: Function, rendering: cst.BaseExpression) -> Optional[_Read]:
        """Return a read that takes what a rendering is made of into the loss, and comes after no line."""
        work: List[Tuple[Function, cst.CSTNode]] = [(function, rendering)]
        found: List[Tuple[Function, cst.CSTNode]]
        carriers: List[_Read] = []
        for where, node in work:  # which grows
            for part, index in _places(node):
                meaning = self.analysis.meanings.meaning(where, part)
                is_picture = meaning.kind in ("image", None) and meaning.role in ("render", "both")
                if part is not rendering and not (is_picture and not SIDES & set(words(path_of(part) or ""))):
                    continue
                carriers.append(_Read(where, part, index))
                for made in where.flow.reaching(part) if len(work) < _MOST else ():
                    if made.kind == "parameter":
                        calls = self.analysis.training.sites.get(where, ())
                        given = [(caller, where.given(call, made.place)) for caller, call in calls]
                        found = [(caller, value) for caller, value in given if value is not None]
                    else:
                        value = made.node if made.kind == "augment" else made.value
                        found = [(where, value)] if value is not None and made.kind != "import" else []
                    work += [entry for entry in found if entry not in work]
        spans = [(where, where.place(node)) for where, node in work[1:]]
        for carrier in carriers:
            for read in self._same(carrier):
                at = read.function.place(read.node).start
                inside = any(where is read.function and span.start <= at < span.end for where, span in spans)
                if not inside and not any(line.covers(read) for line in self.lines):
                    return read
        return None

    def _all(self, function: Function) -> List[_Read]:
        """Return the reads in a function that a backward pass reaches."""
        if function not in self._reads:
            self._reads[function] = [
                _Read(function, node, index)
                for node, index in _places(function.body)
                if self.analysis.training.includes(node) or not self.analysis.training.touches(function)
            ]
        return self._reads[function]

    def _same(self, carrier: _Read) -> Iterator[_Read]:
        """Yield the reads of the same value, or of the whole of it, that a backward pass reaches."""
        function = carrier.function
        known = _definitions(function, carrier.node)
        for read in self._all(function):
            same = path_of(read.node) == path_of(carrier.node) and known & _definitions(function, read.node)
            if same and not _are_apart(read.index, carrier.index):
                yield read


def _definitions(function: Function, node: cst.CSTNode) -> FrozenSet[Definition]:
    """Return the definitions of a place, or of what it is a part of."""
    here = function.flow.reaching(node)
    if not here and isinstance(node, (cst.Attribute, cst.Subscript)):
        return _definitions(function, node.value)
    return here


def _places(node: cst.CSTNode) -> Iterator[Tuple[cst.CSTNode, Optional[cst.Subscript]]]:
    """Yield the places that are read in a node, ``pkg['render']`` and not the ``pkg`` in it, each with its index."""
    stack: List[Tuple[cst.CSTNode, Optional[cst.Subscript]]] = [(node, None)]
    while stack:
        part, index = stack.pop()
        if path_of(part) is not None:
            yield part, index
        elif isinstance(part, cst.Subscript):
            stack += [(part.value, part), *((element, None) for element in part.slice)]
        elif isinstance(part, cst.Call):
            stack += [(arg.value, None) for arg in part.args]
            stack.append((part.func.value if isinstance(part.func, cst.Attribute) else part.func, None))
        elif not isinstance(part, (cst.FunctionDef, cst.ClassDef)):
            stack += [(child, None) for child in children(part)]


def _are_apart(read: Optional[cst.Subscript], picture: Optional[cst.Subscript]) -> bool:
    """Return whether two indices pick different entries of one whole: ``[3:4]`` and ``[:3]``, other formatted keys."""
    if read is None:
        return False
    entries = [_entries(element.slice) for element in read.slice]
    if picture is None:  # the colours of a whole with more channels are its first three
        return (entries[-1] if entries[0] == _ALL else entries[0])[0] >= 3
    others = [_entries(element.slice) for element in picture.slice]
    keys = [one_line(node.slice[0]) for node in (read, picture) if _is_formatted(node.slice[0].slice)]
    return len(set(keys)) == 2 or any(a[1] <= b[0] or b[1] <= a[0] for a, b in zip(entries, others))


def _is_formatted(index: cst.BaseSlice) -> bool:
    return isinstance(index, cst.Index) and isinstance(index.value, cst.FormattedString)


def _entries(index: cst.BaseSlice) -> Tuple[float, float]:
    """Return the bounds of a literal index or slice; of anything else those of all entries."""
    if isinstance(index, cst.Slice):
        low, high = constant(index.lower, 0), constant(index.upper, math.inf)
    else:
        low = constant(index.value) if isinstance(index, cst.Index) else None
        high = low + 1 if isinstance(low, int) else math.inf
    return (low, high) if isinstance(low, int) and isinstance(high, (int, float)) and 0 <= low < high else _ALL


def _blocks_around(function: Function, node: cst.CSTNode) -> Iterator[Tuple[Sequence[cst.CSTNode], int]]:
    """Yield the blocks around a node, the outermost first, each with the index of the statement around it."""
    start = function.place(node).start
    blocks: List[Sequence[cst.CSTNode]] = [function.body.body]
    while blocks:
        found = [
            (block, i)
            for block in blocks
            for i, statement in enumerate(block)
            if function.place(statement).start <= start < function.place(statement).end
        ]
        yield from found
        blocks = [inner for block, i in found for inner in blocks_of(block[i])]


def _is_docstring(node: cst.CSTNode) -> bool:
    first = node.body[0] if isinstance(node, cst.SimpleStatementLine) else None
    return isinstance(first, cst.Expr) and isinstance(first.value, cst.SimpleString)


def _binds(function: Function, node: cst.CSTNode, made: Sequence[Definition]) -> bool:
    """Return whether a statement makes one of these definitions, or leaves the block, in each of its branches."""
    if isinstance(node, (cst.If, cst.Else, cst.With)):
        inside = any(_binds(function, statement, made) for statement in node.body.body)
        other = node.orelse if isinstance(node, cst.If) else node
        return inside and other is not None and (other is node or _binds(function, other, made))
    if not isinstance(node, cst.SimpleStatementLine):
        return False
    span = function.place(node)
    return isinstance(node.body[-1], _LEAVES) or any(
        span.start <= function.place(d.node).start < span.end for d in made
    )


def _site(line: _Line) -> Site:
    function, form = line.function, line.form
    place, anchor = function.place(form.node), function.place(form.before or form.node)
    text = _Pair(function, form.node, form.first, form.second).text
    stands = (function.module.path, place.line, place.column, place.last_line)
    return Site(*stands, form, False, "", f"{text}, before line {anchor.line}", function)
