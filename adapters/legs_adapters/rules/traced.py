"""Join a trace with the plan by reading: what ran is decided by the trace, what did not keeps reading's verdict."""

from __future__ import annotations

import ast
from typing import Any, Dict, Iterator, List, NamedTuple, Optional, Sequence, Set, Tuple

from legs_adapters.code.module import Function
from legs_adapters.code.syntax import arguments, call_name, one_line, walk_expressions
from legs_adapters.rules.analysis import Analysis
from legs_adapters.rules.rule import Term
from legs_adapters.rules.verdict import OF_PIXELS, Verdicts
from legs_adapters.terms.findings import Evidence, Findings, Left, Line, Problem, Site, Use
from legs_adapters.terms.form import Form
from legs_adapters.terms.kinds.callback import PassedByName
from legs_adapters.terms.kinds.called import Called
from legs_adapters.terms.traced import Frame, Trace, Traced

_Place = Tuple[str, int, int]


class _Candidate(NamedTuple):
    """A form on the stack of a traced term: in which frame, and which of its two arguments is the target."""

    function: Function
    form: Form
    depth: int
    target: int

    @property
    def key(self) -> _Place:
        """The path, line and column of its beginning."""
        place = self.function.place(self.form.node)
        return self.function.module.path, place.line, place.column


def with_trace(found: Findings, analysis: Analysis, trace: Trace) -> Findings:
    """Return findings in which the trace decides on every term that ran."""
    return _Join(found, analysis, trace).run()


class _Join:
    def __init__(self, found: Findings, analysis: Analysis, trace: Trace) -> None:
        self.found, self.analysis, self.trace = found, analysis, trace
        self.verdicts = Verdicts(analysis)
        terms = [term for term in trace.terms if not term.is_patched]
        self.is_known = any(term.is_photometric for term in trace.terms)
        self.stacks: List[Tuple[Traced, List[_Candidate]]] = [(term, list(self._candidates(term))) for term in terms]
        self.entries: List[Any] = []
        self.settled: Set[_Place] = set()

    def run(self) -> Findings:
        for traced, stack in sorted(self.stacks, key=lambda each: not each[0].is_photometric):
            if traced.is_photometric:
                self.entries += [entry for entry in self._verdict(traced, stack) if entry not in self.entries]
                self.settled.update(candidate.key for candidate in stack)
            else:
                self._other(traced, stack)
        for traced in self.trace.terms:
            if traced.kind == "weighted" and not traced.is_photometric and (self.is_known or not traced.is_unknown):
                advice = "write what stood there before: legs-patch --undo has it"
                self.entries.append(self._quoted(traced, [], "it is weighted", advice))
        kinds = {"sites": Site, "left": Left, "problems": Problem}
        kept: Dict[str, Any] = {}
        for name in (*kinds, "doubts"):
            kept[name] = [entry for entry in getattr(self.found, name) if not self._is_decided(entry)]
        ran = self.settled.union(candidate.key for _, stack in self.stacks for candidate in stack)
        more = {name: [entry for entry in self.entries if isinstance(entry, kinds[name])] for name in kinds}
        return self.found._replace(**kept, trace=self.trace, ran=frozenset(key[:2] for key in ran)).with_more(**more)

    def _is_decided(self, entry: Any) -> bool:
        if isinstance(entry, Site):
            return entry[:3] in self.settled and not entry.form.term
        return entry[:2] in {key[:2] for key in self.settled}

    # -- the forms on a stack

    def _candidates(self, traced: Traced) -> Iterator[_Candidate]:
        """Yield the forms on a stack whose arguments are the pair, innermost first."""
        for depth, frame in enumerate(traced.frames):
            function = self._function(frame)
            form = self._form(function, traced, depth) if function is not None else None
            if function is not None and form is not None:
                target = self._target_of(traced, traced.frames[depth - 1]) if depth else traced.target
                yield _Candidate(function, form, depth, target)

    def _function(self, frame: Frame) -> Optional[Function]:
        """Return the function of a frame; of a lambda or a comprehension the innermost one that it stands in."""
        module = self.analysis.program.module(frame.path)
        is_any, scopes = frame.name.startswith("<"), module.scopes(lambda _: True) if module is not None else ()
        named = (scope for scope in scopes if is_any or scope.name == frame.name)
        return next(reversed([each for each in named if each.parent is None or _on(each, each.node, frame)]), None)

    def _form(self, function: Function, traced: Traced, depth: int) -> Optional[Form]:
        """Return the form that a frame was at, an L1 or else a call of two pictures; None where it may be another."""
        found = [one for one in self.analysis.forms.in_function(function) if self._is_at(function, one, traced, depth)]
        for call in function.flow.calls if not found and depth and self._is_pair(traced.frames[depth - 1]) else ():
            values, keywords, starred = arguments(call)
            if len(values) == 2 and not (keywords or starred):
                form = Called(call, call, values[0], values[1], call.func)
                found += [form] if self._is_at(function, form, traced, depth) else []
        return found[0] if len(found) == 1 or (found and traced.frames[depth].span) else None

    def _is_at(self, function: Function, form: Form, traced: Traced, depth: int) -> bool:
        """Return whether a frame was at a form, or at the difference that one has elsewhere, and at no argument."""
        frame, nodes = traced.frames[depth], (form.node, getattr(form, "difference", None))
        is_on = any(_on(function, node, frame) for node in nodes if node)
        if not frame.span:
            return is_on and (depth == 0 or self._leads_to(form, traced.frames[depth - 1]))
        inside = (form.first, form.second, *(arg.value for arg in form.extras))
        return is_on and not any(_on(function, node, frame) for node in inside)

    def _leads_to(self, form: Form, inner: Frame) -> bool:
        """Return whether a form's own call led to a frame, and no call in its arguments, as `render(camera)`."""
        has_calls = any(isinstance(node, ast.Call) for node in walk_expressions(form.first, form.second))
        return not has_calls or self._is_pair(inner) or inner.name == call_name(form.call)

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

    def _verdict(self, traced: Traced, stack: List[_Candidate]) -> List[Any]:
        """Return what becomes of a photometric term; nothing where another one has settled it.

        It is weighted at the innermost form that serves no other one; the body of an own L1 function comes last.
        """
        from legs_loss.images import SURELY_NOT_UNIT_RANGE  # which imports torch: reading alone does without

        read = next((site for site in self.found.sites if self._is_passed_on(site, traced)), None)
        if read is not None:
            self.settled.add(read[:3])
        own = [c for c in stack if (c.function.module.path, c.function.name) not in self.trace.scripted]
        is_read = traced.is_read and not all(term.is_read for term in self.trace.terms)
        why = "nothing shows that its gradient is more than read" if is_read else ""
        advice = "give the term of the photograph a line of its own, legs_loss.l1_loss(rendering, photograph)"
        if traced.largest > SURELY_NOT_UNIT_RANGE:  # legs_loss would refuse it in the first step
            why, advice = f"its values go up to {traced.largest:g}", "bring both pictures to [0, 1] before it"
        elif read is not None:
            return [read._replace(why=traced.text(self._name(traced, stack)))]
        for candidate in sorted(own, key=self._is_definition) if not why else ():
            uses = self._others(candidate)
            if uses is not None:
                return [] if candidate.key in self.settled else [self._weighted(traced, candidate, uses)]
        why = why or ("serves other terms of the trace, too" if own else "no call or difference of them alone is there")
        return [self._quoted(traced, stack, why, advice, min(own, key=self._is_definition).depth if own else 0)]

    def _weighted(self, traced: Traced, candidate: _Candidate, uses: List[Use]) -> Any:
        """Return a form as a site, or as a problem where it cannot be edited."""
        function, form = candidate.function, candidate.form
        place, text = function.place(form.node), traced.text(self._name(traced, [candidate]))
        read = next((site for site in self.found.sites if site[:3] == candidate.key and not site.form.term), None)
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
        return Problem(*self._line(traced.frames[depth]), f"{traced.text(self._name(traced, stack))}; {why}", advice)

    def _line(self, frame: Frame) -> Line:
        module = self.analysis.program.module(frame.path)
        return Line(frame.path, frame.line, module.lines.text(frame.line) if module is not None else "")

    def _is_definition(self, candidate: _Candidate) -> bool:
        """Return whether a form is the body of the codebase's own L1 function, whose calls are the terms."""
        return self.analysis.forms.functions.shape(candidate.function) is not None

    @staticmethod
    def _is_passed_on(site: Site, traced: Traced) -> bool:
        """Return whether a site is a function passed by name whose call is on the stack."""
        caller = site.form.caller if isinstance(site.form, PassedByName) else None
        return caller is not None and any(_on(caller, site.form.call, frame) for frame in traced.frames)

    def _others(self, candidate: _Candidate) -> Optional[List[Use]]:
        """Return the calls that lead other terms through a form; None where they cannot be told from the loss's."""
        steps = [(term, depth) for term, _ in self.stacks for depth in range(len(term.frames))]
        through = [step for step in steps if self._is_at(candidate.function, candidate.form, *step)]
        losses = [frame[:3] for traced, _ in through if traced.is_photometric for frame in traced.frames]
        uses = [self._use(*each, candidate, losses) for each in through if not each[0].is_photometric]
        known = [use for use in uses if use is not None]
        return known if len(known) == len(uses) else None

    def _use(self, traced: Traced, depth: int, candidate: _Candidate, losses: List[Any]) -> Optional[Use]:
        """Return the call that led a term into the function of a form, and no photometric one."""
        for frame in traced.frames[depth + 1 : depth + 2]:
            caller = self._function(frame)
            if caller is not None and frame[:3] not in losses:
                calls = (call for call in caller.flow.calls if _on(caller, call, frame))
                named = (call for call in calls if call_name(call) == candidate.function.name)
                why = Evidence("", traced.text(self._name(traced, [])), ())
                return next((Use(caller, call, why, True) for call in named), None)
        return None

    def _other(self, traced: Traced, stack: List[_Candidate]) -> None:
        """Report a term that is not weighted, where no photometric one was decided on its line."""
        own = [candidate for candidate in stack if not self._is_definition(candidate)] or stack
        if any(candidate.key in self.settled for candidate in own):
            return
        # That of a photograph is said: squared, or compiled; signed, or a list of pixels, where no other is known.
        if not stack:
            here = self._line(traced.frames[0])
            is_other = traced.why_other or traced.kind == "l1" or (traced.kind == "signed" and self.is_known)
            is_silent = is_other and (self.is_known or not (traced.is_list and traced.is_l1))
            if not is_silent and here.path in self.analysis.program.sources:
                self.entries.append(Left(*here, traced.text(self._name(traced, [])), (here,)))
                self.settled.update([(here.path, here.line, -1)] if traced.kind != "signed" else [])
            return
        candidate = own[0]
        place, text = candidate.function.place(candidate.form.node), traced.text(self._name(traced, [candidate]))
        left, told = ({one[:2] for one in read} for read in (self.found.left, self.found.sites + self.found.problems))
        if traced.is_unknown and candidate.key[:2] not in left:
            term = Term(self.analysis, candidate.function, candidate.form)
            self.entries.append(self.verdicts.problem(term, place, text))
        elif traced.is_list and traced.is_l1 and candidate.key[:2] in told:
            self.entries.append(Problem.at(candidate.function, place, text, OF_PIXELS))
        else:
            why = Evidence("", text + self._differs(candidate, self.found.sites, "weighted"), ())
            self.entries.append(Left.at(candidate.function, place, why))
        self.settled.update(candidate.key for candidate in own)

    @staticmethod
    def _differs(candidate: _Candidate, read: Sequence[Any], said: str) -> str:
        """Return in words that reading said otherwise, where a line is among what it found."""
        differs = any(entry[:2] == candidate.key[:2] for entry in read)
        return f"; by reading it would be {said}" if differs else ""

    @staticmethod
    def _name(traced: Traced, stack: List[_Candidate]) -> str:
        """Return what the side that wants no gradient is called where a term stands."""
        sides = [((each.form.first, each.form.second)[each.target]) for each in stack if each.target >= 0]
        names = [frame.sides[traced.target] for frame in reversed(traced.frames) if traced.target >= 0]
        return next((name for name in (*map(one_line, sides), *names) if name), "")


def _on(function: Function, node: ast.AST, frame: Frame) -> bool:
    """Return whether what a frame was at lies in a node: before Python 3.11 whether its line does."""
    place, start = function.place(node), function.module.lines.start
    if frame.path != function.module.path or not frame.span:
        return frame.path == function.module.path and place.line <= frame.line <= place.last_line
    last_line, first, last = frame.span
    return place.start <= start(frame.line) + first and start(last_line) + last <= place.end
