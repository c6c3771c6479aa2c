"""Find the photometric L1 terms of a checkout's training steps; and every other L1, with the reason why it is left.

A site is an L1 between a rendering and the ground truth whose value reaches a backward pass. Everything is decided from
the syntax tree; what cannot be decided is a problem that a person settles, never a guess.
"""

from __future__ import annotations

import re
from typing import Iterable, Iterator, List, Mapping, Optional, Sequence, Tuple, Union

import libcst as cst

from legs_adapters.code.module import Function, Module
from legs_adapters.code.parsing import Place
from legs_adapters.code.sources import Source
from legs_adapters.code.syntax import arguments, call_name, dotted, one_line
from legs_adapters.lexicon.meaning import swapped
from legs_adapters.lexicon.views import View
from legs_adapters.rules.analysis import Analysis
from legs_adapters.rules.doubts import Doubt, Doubts
from legs_adapters.rules.order import RULES, first, first_of_call
from legs_adapters.rules.rule import CallOfTerm, Term
from legs_adapters.rules.verdict import Verdicts, left
from legs_adapters.terms.findings import Evidence, Findings, Left, Problem, Site
from legs_adapters.terms.form import Form
from legs_adapters.terms.kinds.callback import Callback
from legs_adapters.terms.kinds.run_time import chosen_at_run_time
from legs_adapters.terms.ssim import STRUCTURAL
from legs_adapters.upstreams import registered

__all__ = ["find"]

_Entry = Tuple[Place, Union[Site, Left, Problem]]

_PATCHED = ("legs_loss.l1_loss", "legs_loss.unweighted")
_MAY_HAVE_L1 = re.compile(r"[lL]1|\babs(olute)?\s*\(|\bunweighted\(")


def find(
    sources: Iterable[Source],
    by_hand: Sequence[Tuple[str, int]] = (),
    unread: Optional[Mapping[str, str]] = None,
) -> Findings:
    """Find the photometric terms of a checkout.

    Args:
        sources: its files.
        by_hand: (path, line) of L1 terms that are sites because the user says so; nothing else is a site then.
        unread: by path, the text of files that are not to be looked at, or cannot be.
    """
    return _Finder(Analysis(sources, unread), by_hand).run()


class _Finder:
    def __init__(self, analysis: Analysis, by_hand: Sequence[Tuple[str, int]]) -> None:
        self.analysis = analysis
        self.by_hand = set(by_hand)
        self.verdicts = Verdicts(analysis)
        self.doubts = Doubts(analysis, self.verdicts)
        self.found = Findings([], [], [], [], [], [], analysis.program)
        self.doubtful: List[Doubt] = []

    def run(self) -> Findings:
        for module in self.analysis.program.matching(_MAY_HAVE_L1):
            self._module(module)
        if not (self.found.sites or self.found.patched or self.found.problems or self.by_hand):
            self.found.problems.extend(doubt.problem for doubt in self.doubtful)
            quoted = {(problem.path, problem.line) for problem, _ in self.doubtful}
            self.found.left[:] = [left for left in self.found.left if (left.path, left.line) not in quoted]
        elif not self.by_hand:
            self.found.doubts.extend(doubt.problem for doubt in self.doubtful if self._trains_alone(doubt))
        self.found.unreadable.extend(
            self.analysis.program.unreadable[path] for path in sorted(self.analysis.program.unreadable)
        )
        return self.found

    def _trains_alone(self, doubt: Doubt) -> bool:
        """Whether its file trains something, in which nothing was weighted or quoted."""
        settled = {site.path for site in self.found.sites} | {entry.path for entry in self.found.patched}
        settled |= {problem.path for problem in self.found.problems}
        path = doubt.problem.path
        trains = any(root.module.path == path for root in self.analysis.training.roots)
        return trains and doubt.is_told_beside_sites and path not in settled

    def _module(self, module: Module) -> None:
        entries: List[_Entry] = []
        patched: List[Left] = []
        try:
            for function in module.scopes(lambda text: self.analysis.prospects.of(text) or STRUCTURAL.search(text)):
                entries += self._entries(function)
                patched += self._patched(function)
        except ValueError:
            self.analysis.program.give_up(module.path, "cannot be written back exactly")
            return
        if module.failure is not None:
            return
        for _, entry in sorted(entries, key=lambda item: (item[0].line, item[0].column)):
            if isinstance(entry, Site):
                self.found.sites.append(entry)
            elif isinstance(entry, Problem):
                self.found.problems.append(entry)
            else:
                self.found.left.append(entry)
        self.found.patched.extend(sorted(patched, key=lambda entry: entry.line))

    def _entries(self, function: Function) -> Iterator[_Entry]:
        """What is to be said of each L1 in a function, with where it is."""
        # Elsewhere an L1 could only be one by a name of a name, and nothing trains on it.
        if self.analysis.prospects.near(function.text) or self.analysis.training.touches(function):
            yield from self._of_forms(function)
            if not self.by_hand:
                yield from self._of_kernels(function)
        if STRUCTURAL.search(function.text):
            yield from self._of_chosen(function)
        yield from self._of_callables(function)
        self._look_at_names(function)

    def _of_forms(self, function: Function) -> Iterator[_Entry]:
        for form in self.analysis.forms.of(function):
            place = function.place(form.node)
            chosen = self._is_chosen(function, place)
            verdict = self.verdicts.of(function, form, place, chosen)
            if isinstance(verdict, Left) and self.doubts.is_doubtful(function, form, verdict):
                self.doubtful.append(self.doubts.of(function, form, place, verdict))
            if self.by_hand and not chosen and not isinstance(verdict, Left):
                verdict = left(function, place, "not chosen")
            if not (isinstance(verdict, Left) and self.doubts.is_noise(function, form, verdict)):
                yield place, verdict

    def _of_chosen(self, function: Function) -> Iterator[_Entry]:
        for form in chosen_at_run_time(
            self.analysis.program, self.analysis.training, function, self.analysis.forms.of(function)
        ):
            place = function.place(form.node)
            if self._is_chosen(function, place):
                yield place, self.verdicts.of(function, form, place, True)
            elif not self.by_hand:
                yield place, self._of_any(function, form, place)

    def _of_kernels(self, function: Function) -> Iterator[_Entry]:
        for call in function.flow.calls:
            if self._is_kernel(function, call):
                place = function.place(call)
                yield place, self._of_kernel(function, call, place)

    def _of_callables(self, function: Function) -> Iterator[_Entry]:
        callables = [
            (entry.form, self._why_not_handed(function, entry))
            for entry in self.analysis.callbacks.by_holder.get(function, ())
        ]
        for call in function.flow.calls if registered.MENTIONED.search(function.text) else ():
            callables += [(form, None) for form in registered.forms_of(self.analysis.program, function, call)]
        for form, reason in callables:
            place = function.place(form.node)
            if not self.by_hand or self._is_chosen(function, place):
                yield place, left(function, place, reason) if reason else self._callable(function, form, place)

    def _look_at_names(self, function: Function) -> None:
        """Note torch's L1 under a name that no call in sight uses: ``base = F.l1_loss``, for a function made here."""
        known = {id(entry.form.node) for entry in self.analysis.callbacks.by_holder.get(function, ())}
        known |= {id(value) for form in self.analysis.forms.of(function) for value in self._named(function, form)}
        for definition in [each for found in function.flow.definitions.values() for each in found]:
            value = definition.value
            if definition.kind != "assign" or id(value) in known or not isinstance(value, (cst.Name, cst.Attribute)):
                continue
            if self.analysis.forms.functions.is_l1(function, value) and not self._is_called(function, definition.place):
                module, line = function.module, function.place(value).line
                why = f"nothing shows where {definition.place} is called"
                advice = f"legs_loss.l1_loss(rendering, photograph, own={one_line(value)}), where it is called"
                problem = Problem(module.path, line, module.lines.text(line), why, advice)
                self.doubtful.append(Doubt(problem))

    def _is_called(self, function: Function, place: str) -> bool:
        """Whether ``self.loss`` is called by another method of its class."""
        owner = self.analysis.program.owner_of(function)
        methods = owner.methods.values() if owner is not None and place.startswith("self.") else ()
        return any(dotted(call.func) == place for method in methods for call in method.flow.calls)

    @staticmethod
    def _named(function: Function, form: Form) -> List[Optional[cst.CSTNode]]:
        """What the function that a form calls was given its name as."""
        return [d.value for d in function.flow.reaching(form.callee)] if form.callee is not None else []

    def _is_kernel(self, function: Function, call: cst.Call) -> bool:
        """``fused_l1_ssim_loss(image, gt)``: L1 and SSIM in one, and not in this checkout."""
        name = call_name(call).lower()
        if "l1" not in name or "ssim" not in name or len(call.args) < 2 or not self.analysis.training.includes(call):
            return False
        return all(reference.kind == "external" for reference in self.analysis.program.resolve(function, call.func))

    def _of_kernel(self, function: Function, call: cst.Call, place: Place) -> Problem:
        module = function.module
        sides = ", ".join(one_line(arg.value) for arg in call.args[:2])
        advice = f"(1 - w) * legs_loss.l1_loss({sides}) + w * legs_loss.d_ssim({sides})"
        why = "L1 and SSIM are one function here; with w, its weight of SSIM, they are two"
        return Problem(module.path, place.line, module.lines.text(place.line), why, advice)

    def _of_any(self, function: Function, form: Form, place: Place) -> Left | Problem:
        term = Term(self.analysis, function, form)
        evidence = first(term)
        if evidence is not None:
            return left(function, place, evidence)
        assert form.callee is not None
        why = f"{one_line(form.callee)} is settled at run time, and may be no L1"
        return self.verdicts.problem(function, form, place, why, bool(swapped(term.pair.a, term.pair.b)))

    def _is_chosen(self, function: Function, place: Place) -> bool:
        path = function.module.path
        return any(path == chosen and place.line <= line <= place.last_line for chosen, line in self.by_hand)

    @staticmethod
    def _callable(function: Function, form: Form, place: Place) -> Site:
        view = View(None, "a callable has no view")
        where = (function.module.path, place.line, place.column, place.line)
        return Site(*where, form, False, "", False, view, function)

    def _why_not_handed(self, holder: Function, entry: Callback) -> Optional[Evidence]:
        term = Term(self.analysis, entry.caller, entry.form)
        unknown = RULES["unknown"].found(term.here)
        evidence = first(term)
        if evidence is None and entry.outer is not None:
            given = [self.analysis.meanings.of(holder, value) for value in arguments(entry.outer)[0][:2]]
            evidence = first_of_call(CallOfTerm(self.analysis, holder, entry.outer, given)) if given else unknown
        return unknown if evidence is None and swapped(term.pair.a, term.pair.b) is not False else evidence

    def _patched(self, function: Function) -> List[Left]:
        """What refers to legs_loss already: calls, and names that it is given."""
        if "legs_loss" not in function.module.text:
            return []
        nodes: List[cst.CSTNode] = [call.func for call in function.flow.calls]
        for definitions in function.flow.definitions.values():
            nodes.extend(d.value for d in definitions if d.kind == "assign" and isinstance(d.value, cst.Attribute))
        return [
            left(function, function.place(node), "patched")
            for node in nodes
            if any(r.kind == "external" and r.target in _PATCHED for r in self.analysis.program.resolve(function, node))
        ]

    # -- one form
