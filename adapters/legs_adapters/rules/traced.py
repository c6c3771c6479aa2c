"""Join a trace with the plan by reading: what ran is decided by the trace, what did not keeps reading's verdict."""

from __future__ import annotations

import ast
from typing import Any, Dict, Iterator, List, NamedTuple, Optional, Sequence, Set, Tuple

from legs_adapters.code.module import Function
from legs_adapters.code.syntax import arguments, call_name, one_line, walk_expressions
from legs_adapters.rules.analysis import Analysis
from legs_adapters.rules.rule import Term
from legs_adapters.rules.verdict import Verdicts
from legs_adapters.terms.findings import Evidence, Findings, Left, Line, Problem, Site, Use
from legs_adapters.terms.form import Form
from legs_adapters.terms.kinds.callback import PassedByName
from legs_adapters.terms.kinds.called import Called
from legs_adapters.terms.traced import Frame, Trace, Traced

_Place = Tuple[str, int]


class _Candidate(NamedTuple):
    """A form on the stack of a traced term: in which frame, and which of its two arguments is the target."""

    function: Function
    form: Form
    depth: int
    target: int

    @property
    def key(self) -> _Place:
        """The path and line of its beginning."""
        return self.function.module.path, self.function.place(self.form.node).line


def with_trace(found: Findings, analysis: Analysis, trace: Trace) -> Findings:
    """Return findings in which the trace decides on every term that ran."""
    return _Join(found, analysis, trace).run()


class _Join:
    def __init__(self, found: Findings, analysis: Analysis, trace: Trace) -> None:
        self.found, self.analysis, self.trace = found, analysis, trace
        self.verdicts = Verdicts(analysis)
        terms = [term for term in trace.terms if not term.is_patched]
        self.stacks: List[Tuple[Traced, List[_Candidate]]] = [(term, list(self._candidates(term))) for term in terms]
        self.entries: List[Any] = []
        self.settled: Set[_Place] = set()

    def run(self) -> Findings:
        for traced, stack in self.stacks:
            if traced.is_photometric:
                self._photometric(traced, stack)
        for traced, stack in self.stacks:
            if not traced.is_photometric:
                self._other(traced, stack)
        is_known = any(term.is_photometric for term in self.trace.terms)
        for traced in self.trace.terms:
            if traced.kind == "weighted" and not traced.is_photometric and (is_known or not traced.is_unknown):
                advice = "write what stood there before: legs-patch --undo has it"
                self.entries.append(self._quoted(traced, [], "it is weighted", advice))
        kinds = {"sites": Site, "left": Left, "problems": Problem}
        kept: Dict[str, Any] = {}
        for name in (*kinds, "doubts"):
            kept[name] = [entry for entry in getattr(self.found, name) if not self._is_decided(entry)]
        ran = self.settled.union(candidate.key for _, stack in self.stacks for candidate in stack)
        more = {name: [entry for entry in self.entries if isinstance(entry, kinds[name])] for name in kinds}
        return self.found._replace(**kept, trace=self.trace, ran=frozenset(ran)).with_more(**more)

    def _is_decided(self, entry: Any) -> bool:
        return (entry.path, entry.line) in self.settled and not (isinstance(entry, Site) and entry.form.term)

    # -- the forms on a stack

    def _candidates(self, traced: Traced) -> Iterator[_Candidate]:
        """Yield the forms on a stack whose arguments are the pair, innermost first."""
        inner: Optional[Frame] = None
        for depth, frame in enumerate(traced.frames):
            function = self._function(frame)
            form = self._form(function, frame.line, inner) if function is not None else None
            if function is not None and form is not None and (inner is None or self._leads_to(form, inner)):
                target = traced.target if inner is None else self._target_of(traced, inner)
                yield _Candidate(function, form, depth, target)
            inner = frame

    def _function(self, frame: Frame) -> Optional[Function]:
        """Return the function of a frame; of a comprehension the one that it stands in."""
        module = self.analysis.program.module(frame.path)
        if module is None:
            return None
        if frame.name == "<module>":
            return module.top
        is_any, scopes = frame.name.startswith("<"), module.scopes(lambda _: True)
        named = [scope for scope in scopes if scope is not module.top and (is_any or scope.name == frame.name)]
        before = [scope for scope in named if scope.place(scope.node).line <= frame.line]
        return max(before, key=lambda scope: scope.place(scope.node).line, default=None)

    def _form(self, function: Function, line: int, inner: Optional[Frame]) -> Optional[Form]:
        for form in self.analysis.forms.in_function(function):
            if any(_on(function, node, line) for node in (form.node, getattr(form, "difference", None)) if node):
                return form
        for call in function.flow.calls if inner is not None and self._is_pair(inner) else ():
            values, keywords, starred = arguments(call)
            if _on(function, call, line) and len(values) == 2 and not (keywords or starred):
                return Called(call, call, values[0], values[1], call.func)
        return None

    def _leads_to(self, form: Form, inner: Frame) -> bool:
        """Return whether a form's own call led to a frame, and not a call in its arguments, as `render(camera)`."""
        inside = (node for side in (form.first, form.second) for node in walk_expressions(side))
        within = {call_name(node) for node in inside if isinstance(node, ast.Call)}
        if inner.name in ("forward", "__call__"):
            return not within or self._is_pair(inner)
        return inner.name not in within or inner.name == call_name(form.call)

    def _is_pair(self, frame: Frame) -> bool:
        """Return whether the first two parameters of a frame's function are the two sides."""
        return "" not in frame.sides and set(self._parameters(frame)) == set(frame.sides)

    def _parameters(self, frame: Frame) -> List[str]:
        function = self._function(frame)
        return [] if function is None else function.parameters[:2]

    def _target_of(self, traced: Traced, frame: Frame) -> int:
        """Return which argument of a call is the target: the position of its name among the callee's parameters."""
        name, parameters = frame.sides[traced.target] if traced.target >= 0 else "", self._parameters(frame)
        return parameters.index(name) if name in parameters else -1

    # -- verdicts

    def _photometric(self, traced: Traced, stack: List[_Candidate]) -> None:
        """Weight a term at the innermost form that serves no other one; the body of an own L1 function comes last."""
        self.entries += self._verdict(traced, stack)
        self.settled.update(candidate.key for candidate in stack)

    def _verdict(self, traced: Traced, stack: List[_Candidate]) -> List[Any]:
        """Return what becomes of a photometric term; nothing where another one has settled it."""
        read = next((site for site in self.found.sites if self._is_passed_on(site, traced)), None)
        if read is not None:
            self.settled.add((read.path, read.line))
            return [read._replace(why=traced.text(self._name(traced, stack)))]
        own = [c for c in stack if (c.function.module.path, c.function.name) not in self.trace.scripted]
        is_read = any(self.analysis.training.scores(candidate.form.node) for candidate in own)
        for candidate in sorted(own, key=self._is_definition) if not is_read else ():
            uses = self._others(candidate)
            if uses is not None:
                return [] if candidate.key in self.settled else [self._weighted(traced, candidate, uses)]
        why = "serves other terms of the trace, too" if own else "no call or difference of the two pictures is there"
        why = "nothing shows that its gradient is more than read" if is_read else why
        advice = "give the term of the photograph a line of its own, legs_loss.l1_loss(rendering, photograph)"
        return [self._quoted(traced, stack, why, advice, min(own, key=self._is_definition).depth if own else 0)]

    def _weighted(self, traced: Traced, candidate: _Candidate, uses: List[Use]) -> Any:
        """Return a form as a site, or as a problem where it cannot be edited."""
        function, form = candidate.function, candidate.form
        place, text = function.place(form.node), traced.text(self._name(traced, [candidate]))
        sites = [site for site in self.found.sites if not site.form.term and (site.path, site.line) == candidate.key]
        read = next((site for site in sites if site.column == place.column), None)
        verdict: Any = read or self.verdicts.decide(function, form, place, True)
        if isinstance(verdict, Problem):
            return verdict._replace(reason=f"{text}; {verdict.reason}")
        if isinstance(verdict, Site):
            is_swapped = candidate.target == 0 if candidate.target >= 0 else verdict.swapped
            ran = {frame[:2] for term in self.trace.terms if term.is_photometric for frame in term.frames}
            kept = [use for use in verdict.unweighted if (use.left.path, use.left.line) not in ran]
            why = text + self._differs(candidate, self.found.left, "skipped")
            return verdict._replace(swapped=is_swapped, why=why, unweighted=(*kept, *uses))
        return verdict

    def _quoted(self, traced: Traced, stack: List[_Candidate], why: str, advice: str, depth: int = 0) -> Problem:
        """Return a line of a term's stack as one that cannot be decided."""
        reason = f"{traced.text(self._name(traced, stack))}; {why}"
        return Problem(*self._line(traced.frames[depth]), reason, advice)

    def _line(self, frame: Frame) -> Line:
        module = self.analysis.program.module(frame.path)
        return Line(frame.path, frame.line, module.lines.text(frame.line) if module is not None else "")

    def _is_definition(self, candidate: _Candidate) -> bool:
        """Return whether a form is the body of the codebase's own L1 function, whose calls are the terms."""
        return self.analysis.forms.functions.shape(candidate.function) is not None

    @staticmethod
    def _is_passed_on(site: Site, traced: Traced) -> bool:
        """Return whether a site is a function passed by name whose call is on the stack."""
        form = site.form
        if not isinstance(form, PassedByName) or form.caller is None:
            return False
        caller, call = form.caller, form.call
        return any(frame.path == caller.module.path and _on(caller, call, frame.line) for frame in traced.frames)

    def _others(self, candidate: _Candidate) -> Optional[List[Use]]:
        """Return the calls that lead other terms through a form; None where they cannot be told from the loss's."""
        through = [(traced, c.depth) for traced, stack in self.stacks for c in stack if c.key == candidate.key]
        losses = {frame[:2] for traced, _ in through if traced.is_photometric for frame in traced.frames}
        uses = [self._use(*each, candidate, losses) for each in through if not each[0].is_photometric]
        known = [use for use in uses if use is not None]
        return known if len(known) == len(uses) else None

    def _use(self, traced: Traced, depth: int, candidate: _Candidate, losses: Set[_Place]) -> Optional[Use]:
        """Return the call that led a term into the function of a form, and no photometric one."""
        for frame in traced.frames[depth + 1 : depth + 2]:
            caller = self._function(frame)
            if caller is not None and frame[:2] not in losses:
                calls = [call for call in caller.flow.calls if _on(caller, call, frame.line)]
                why = Evidence("", traced.text(self._name(traced, [])), ())
                uses = [Use(caller, call, why, True) for call in calls if call_name(call) == candidate.function.name]
                return next(iter(uses), None)
        return None

    def _other(self, traced: Traced, stack: List[_Candidate]) -> None:
        """Report a term that is not weighted, where no photometric one was decided on its line."""
        own = [candidate for candidate in stack if not self._is_definition(candidate)] or stack
        if any(candidate.key in self.settled for candidate in own):
            return
        if not stack:  # that of a photograph is said: it is squared, or compiled
            here = self._line(traced.frames[0])
            is_said = traced.kind not in ("l1", "signed") and not traced.why_other
            if is_said and here.path in self.analysis.program.sources:
                self.entries.append(Left(*here, traced.text(self._name(traced, [])), (here,)))
                self.settled.add((here.path, here.line))
            return
        candidate = own[0]
        place, text = candidate.function.place(candidate.form.node), traced.text(self._name(traced, [candidate]))
        is_left = any((entry.path, entry.line) == candidate.key for entry in self.found.left)
        if traced.is_unknown and not is_left:
            term = Term(self.analysis, candidate.function, candidate.form)
            self.entries.append(self.verdicts.problem(term, place, text))
        else:
            why = Evidence("", text + self._differs(candidate, self.found.sites, "weighted"), ())
            self.entries.append(Left.at(candidate.function, place, why))
        self.settled.update(candidate.key for candidate in own)

    @staticmethod
    def _differs(candidate: _Candidate, read: Sequence[Any], said: str) -> str:
        """Return in words that reading said otherwise, where a line is among what it found."""
        differs = any((entry.path, entry.line) == candidate.key for entry in read)
        return f"; by reading it would be {said}" if differs else ""

    @staticmethod
    def _name(traced: Traced, stack: List[_Candidate]) -> str:
        """Return what the side that wants no gradient is called where a term stands."""
        for candidate in stack:
            if candidate.target >= 0:
                return one_line((candidate.form.first, candidate.form.second)[candidate.target])
        names = [frame.sides[traced.target] for frame in traced.frames if traced.target >= 0]
        return next((name for name in reversed(names) if name), "")


def _on(function: Function, node: ast.AST, line: int) -> bool:
    place = function.place(node)
    return place.line <= line <= place.last_line
