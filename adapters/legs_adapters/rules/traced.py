"""Join a trace with the plan by reading: what ran is decided by the trace, what did not keeps reading's verdict."""

from __future__ import annotations

from typing import Any, Dict, Iterator, List, NamedTuple, Optional, Set, Tuple

import libcst as cst
import libcst.matchers as m

from legs_adapters.code.module import Function
from legs_adapters.code.syntax import arguments, call_name, one_line
from legs_adapters.rules.analysis import Analysis
from legs_adapters.rules.rule import Term
from legs_adapters.rules.verdict import Verdicts
from legs_adapters.terms.findings import Evidence, Findings, Left, Line, Problem, Site, Use
from legs_adapters.terms.form import Form
from legs_adapters.terms.kinds.callback import PassedByName
from legs_adapters.terms.kinds.called import Called
from legs_adapters.terms.traced import Trace, Traced

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
        self.stacks: List[Tuple[Traced, List[_Candidate]]] = [(term, list(self._candidates(term))) for term in terms]
        self.is_known: bool = any(term.is_photometric for term in trace.terms)
        self.entries: List[Any] = []
        self.settled: Set[_Place] = set()

    def run(self) -> Findings:
        for traced, stack in self.stacks:
            if traced.is_photometric:
                self._photometric(traced, stack)
        for traced, stack in self.stacks:
            if not traced.is_photometric:
                self._other(traced, stack)
        for traced in self.trace.terms:
            if traced.kind == "weighted" and not traced.is_photometric and (self.is_known or not traced.is_unknown):
                self._quote(traced, "it is weighted", "write what stood there before: legs-patch --undo has it", 0)
        ran = self.settled.union(candidate.key for _, stack in self.stacks for candidate in stack)
        kept: Dict[str, Any] = {}
        for name in ("sites", "left", "problems", "doubts"):
            kept[name] = [entry for entry in getattr(self.found, name) if not self._is_decided(entry)]
        found = self.found._replace(**kept, trace=self.trace, ran=frozenset((path, line) for path, line, _ in ran))
        kinds = {"sites": Site, "left": Left, "problems": Problem}
        return found.with_more(**{name: [e for e in self.entries if isinstance(e, kinds[name])] for name in kinds})

    def _is_decided(self, entry: Any) -> bool:
        if isinstance(entry, Site) and entry.form.term:
            return False
        return any((entry.path, entry.line) == (path, line) for path, line, _ in self.settled)

    # -- the forms on a stack

    def _candidates(self, traced: Traced) -> Iterator[_Candidate]:
        """Yield the forms on a stack whose arguments are the pair, innermost first."""
        for depth, (path, line, name, _) in enumerate(traced.frames):
            inner = traced.frames[depth - 1] if depth else None
            for function in self._functions(path, line, name):
                form = self._form(function, line, inner)
                if form is not None and (inner is None or self._leads_to(form, inner)):
                    target = traced.target if inner is None else self._target_of(traced, inner)
                    yield _Candidate(function, form, depth, target)

    def _functions(self, path: str, line: int, name: str) -> List[Function]:
        """Return the function of a frame, in a list; of a comprehension the one that it stands in."""
        module = self.analysis.program.module(path)
        if module is None or name == "<module>":
            return [module.top] if module is not None else []
        scopes = [scope for scope in module.scopes(lambda _: True) if scope is not module.top]
        before = [scope for scope in scopes if scope.place(scope.node).line <= line]
        named = [scope for scope in before if scope.name == name or name.startswith("<")]
        return [max(named, key=lambda scope: scope.place(scope.node).line)] if named else []

    def _form(self, function: Function, line: int, inner: Optional[Any]) -> Optional[Form]:
        forms = [f for f in self.analysis.forms.in_function(function) if _on(function, f.node, line)]
        if forms:
            return forms[0]
        for call in function.flow.calls if inner is not None else ():
            values, keywords, starred = arguments(call)
            if _on(function, call, line) and len(values) == 2 and not (keywords or starred) and self._is_pair(inner):
                return Called(call, call, values[0], values[1], call.func)
        return None

    def _leads_to(self, form: Form, inner: Any) -> bool:
        """Return whether a form's own call led to a frame, and not a call in its arguments, as `render(camera)`."""
        calls = [call for side in (form.first, form.second) for call in m.findall(side, m.Call())]
        within = {call_name(cst.ensure_type(call, cst.Call)) for call in calls}
        if inner[2] in ("forward", "__call__"):
            return not within or self._is_pair(inner)
        return inner[2] not in within or inner[2] == call_name(form.call)

    def _is_pair(self, frame: Any) -> bool:
        """Return whether the first two parameters of a frame's function are the two sides."""
        parameters = self._parameters(frame)
        return len(parameters) > 1 and set(parameters[:2]) == set(frame[3]) and "" not in frame[3]

    def _parameters(self, frame: Any) -> List[str]:
        return next((function.parameters for function in self._functions(*frame[:3])), [])

    def _target_of(self, traced: Traced, frame: Any) -> int:
        """Return which argument of a call is the target: the position of its name among the callee's parameters."""
        name, parameters = frame[3][traced.target] if traced.target >= 0 else "", self._parameters(frame)
        return parameters.index(name) if name in parameters[:2] else -1

    # -- verdicts

    def _photometric(self, traced: Traced, stack: List[_Candidate]) -> None:
        scripted = self.trace.scripted
        own = [c for c in stack if (c.function.module.path, c.function.name) not in scripted]
        own.sort(key=self._is_definition)
        read = next((site for site in self.found.sites if self._is_passed_on(site, traced)), None)
        if read is not None:
            self.entries.append(read._replace(why=traced.text(self._name(traced, stack))))
            self._settle(stack)
            self.settled.add((read.path, read.line, read.column))
            return
        for candidate in own:
            if self._others(candidate) is not None:
                self._write(traced, candidate)
                return
        why = "serves other terms of the trace, too" if own else "no call or difference of the two pictures is there"
        self._settle(stack)
        advice = "give the term of the photograph a line of its own, legs_loss.l1_loss(rendering, photograph)"
        self._quote(traced, why, advice, own[0].depth if own else 0, self._name(traced, stack))

    def _quote(self, traced: Traced, why: str, advice: str, depth: int, name: str = "") -> None:
        """Report a line of a term's stack as one that cannot be decided."""
        self.entries.append(Problem(*self._line(traced.frames[depth]), f"{traced.text(name)}; {why}", advice))

    def _line(self, frame: Any) -> Line:
        module = self.analysis.program.module(frame[0])
        return Line(frame[0], frame[1], module.lines.text(frame[1]) if module is not None else "")

    def _is_definition(self, candidate: _Candidate) -> bool:
        """Return whether a form is the body of the codebase's own L1 function, whose calls are the terms."""
        return self.analysis.forms.functions.shape(candidate.function) is not None

    @staticmethod
    def _is_passed_on(site: Site, traced: Traced) -> bool:
        """Return whether a site is a function passed by name whose call is on the stack."""
        form = site.form
        if not isinstance(form, PassedByName) or form.caller is None:
            return False
        place = form.caller.place(form.call)
        lines = [line for path, line, *_ in traced.frames if path == form.caller.module.path]
        return any(place.line <= line <= place.last_line for line in lines)

    def _others(self, candidate: _Candidate) -> Optional[List[Use]]:
        """Return the calls that lead other terms through a form; None where they cannot be told from the loss's."""
        if self._is_shared(candidate):
            return None
        losses: List[Traced] = []
        others: List[Traced] = []
        for traced, stack in self.stacks:
            if any(c.key == candidate.key for c in stack):
                (losses if traced.is_photometric else others).append(traced)
        uses: Dict[_Place, Use] = {}
        for traced in others:
            use = self._use(traced, candidate, losses)
            if use is None:
                return None
            uses[use.left.path, use.left.line, 0] = use
        return list(uses.values())

    def _is_shared(self, candidate: _Candidate) -> bool:
        """Return whether the call of a form calls other losses, too: `LOSSES[name](image, gt)` in a loop."""
        callees: Set[Tuple[bool, Tuple[str, str]]] = set()
        name = call_name(candidate.form.call)
        for traced, stack in self.stacks:
            for depth in (c.depth for c in stack if c.key == candidate.key):
                path, _, called, _ = traced.frames[depth - 1] if depth else ("", 0, traced.kind, ())
                callees.add((traced.is_photometric, (path, called)))
        is_named = any(called[1] == name for _, called in callees) or candidate.depth == 0
        return not is_named and any(not is_loss for is_loss, _ in callees)

    def _use(self, traced: Traced, candidate: _Candidate, losses: List[Traced]) -> Optional[Use]:
        """Return the call that led a term into the function of a form, and no photometric one."""
        if candidate.function.node is candidate.function.module.top.node:
            return None
        depth = next(c.depth for t, stack in self.stacks if t is traced for c in stack if c.key == candidate.key) + 1
        if depth >= len(traced.frames):
            return None
        path, line, name, _ = traced.frames[depth]
        if any((path, line) in [frame[:2] for frame in loss.frames] for loss in losses):
            return None
        for caller in self._functions(path, line, name):
            for call in caller.flow.calls:
                if _on(caller, call, line) and call_name(call) == candidate.function.name:
                    reason = traced.text(self._name(traced, []))
                    return Use(caller, call, Evidence("", reason, ()), True)
        return None

    def _write(self, traced: Traced, candidate: _Candidate) -> None:
        function, form = candidate.function, candidate.form
        place, uses = function.place(form.node), tuple(self._others(candidate) or ())
        text = traced.text(self._name(traced, [candidate]))
        sites = [site for site in self.found.sites if not site.form.term]
        read = next((site for site in sites if (site.path, site.line, site.column) == candidate.key), None)
        verdict: Any = read or self.verdicts.decide(function, form, place, True)
        if isinstance(verdict, Site):
            if candidate.target >= 0:
                verdict = verdict._replace(swapped=candidate.target == 0)
            known = {use.call for use in uses}
            kept = tuple(use for use in verdict.unweighted if use.call not in known)
            verdict = verdict._replace(why=text + self._differs(candidate, True), unweighted=(*kept, *uses))
        elif isinstance(verdict, Problem):
            verdict = verdict._replace(reason=f"{text}; {verdict.reason}")
        if candidate.key not in self.settled:
            self.entries.append(verdict)
        self._settle([c for t, stack in self.stacks if traced is t for c in stack])

    def _other(self, traced: Traced, stack: List[_Candidate]) -> None:
        """Report a term that is not weighted, where no photometric one was decided on its line."""
        own = [c for c in stack if not self._is_definition(c)] or stack
        if any(c.key in self.settled for c in stack):
            return
        if not own:
            return self._without_form(traced)
        candidate = own[0]
        place, text = candidate.function.place(candidate.form.node), traced.text(self._name(traced, [candidate]))
        read = [entry for entry in self.found.sites if (entry.path, entry.line) == candidate.key[:2]]
        is_left = any((entry.path, entry.line) == candidate.key[:2] for entry in self.found.left)
        if traced.is_unknown and (read or not is_left):
            if read and not self.is_known:
                return  # its pictures come from elsewhere: reading decides
            term = Term(self.analysis, candidate.function, candidate.form)
            self.entries.append(self.verdicts.problem(term, place, text))
        else:
            why = Evidence("", text + self._differs(candidate, False), ())
            self.entries.append(Left.at(candidate.function, place, why))
        self._settle(own)

    def _without_form(self, traced: Traced) -> None:
        """Report a photograph's loss that is no L1: squared, or compiled."""
        here = self._line(traced.frames[0])
        if traced.kind not in ("l1", "signed") and not traced.why_other and here.path in self.analysis.program.sources:
            self.entries.append(Left(*here, traced.text(self._name(traced, [])), (here,)))
            self.settled.add((here.path, here.line, 0))

    def _differs(self, candidate: _Candidate, is_loss: bool) -> str:
        """Return in words that reading said otherwise."""
        read: Any = self.found.left if is_loss else self.found.sites
        said = "skipped" if is_loss else "weighted"
        differs = any((entry.path, entry.line) == candidate.key[:2] for entry in read)
        return f"; by reading it would be {said}" if differs else ""

    def _settle(self, stack: List[_Candidate]) -> None:
        self.settled.update(candidate.key for candidate in stack)

    @staticmethod
    def _name(traced: Traced, stack: List[_Candidate]) -> str:
        """Return what the side that wants no gradient is called where a term stands."""
        for candidate in stack:
            if candidate.target >= 0:
                return one_line((candidate.form.first, candidate.form.second)[candidate.target])
        names = [frame[3][traced.target] for frame in traced.frames if traced.target >= 0 and frame[3][traced.target]]
        return names[-1] if names else ""


def _on(function: Function, node: cst.CSTNode, line: int) -> bool:
    place = function.place(node)
    return place.line <= line <= place.last_line
