"""Find the photometric L1 terms of a checkout's training steps; and every other L1, with the reason why it is skipped.

A site is an L1 between a rendering and the ground truth whose value reaches a backward pass. Everything is decided from
the syntax tree; a term that cannot be decided becomes a problem that needs a manual edit, never a guess.
"""

from __future__ import annotations

import re
from typing import Any, Dict, FrozenSet, Iterable, Iterator, List, Optional, Sequence, Set, Tuple, Union

from legs_adapters.code.limits import Budget
from legs_adapters.code.module import Function, Module
from legs_adapters.code.parsing import Place
from legs_adapters.code.program import Program
from legs_adapters.code.sources import Source
from legs_adapters.code.syntax import arguments, call_name
from legs_adapters.lexicon.words import NO_L1, SPEAKS_OF_L1
from legs_adapters.rules.analysis import Analysis
from legs_adapters.rules.causes.kinds import KINDS
from legs_adapters.rules.masks import with_masks
from legs_adapters.rules.order import RULES, first
from legs_adapters.rules.rule import Term
from legs_adapters.rules.ssim import with_ssims
from legs_adapters.rules.traced import with_trace
from legs_adapters.rules.verdict import Verdicts
from legs_adapters.tensors.backward import TRAINS
from legs_adapters.tensors.operations import HOOKS, MODULE_SELF, MODULE_WRAPS
from legs_adapters.terms.findings import Findings, Left, Problem, Site
from legs_adapters.terms.form import Form
from legs_adapters.terms.kinds.called import Called
from legs_adapters.terms.patched import patched_nodes
from legs_adapters.terms.traced import Trace
from legs_loss.system.terminal import progress

_Entry = Tuple[Place, Union[Site, Left, Problem]]

_RULES = 100  # steps at most of what all rules ask about a term
_TEXT = 50  # letters of a text that are searched in a step
_TO_READ = re.compile(rf"{SPEAKS_OF_L1.pattern}|unweighted\(|{TRAINS.pattern}|{'|'.join(sorted(HOOKS))}")


def find(
    sources: Iterable[Source],
    by_hand: Sequence[Tuple[str, int]] = (),
    ssim: bool = False,
    masks: bool = False,
    trace: Optional[Trace] = None,
    budget: Optional[Budget] = None,
) -> Findings:
    """Find the photometric terms of a checkout.

    Args:
        sources: its files.
        by_hand: (path, line) of the L1 terms that the user named as sites; nothing else is a site then.
        ssim: find the SSIM terms, too.
        masks: find where their renderings are masked, too, and the SSIM terms that can be means over what counts.
        trace: what a run of the training script showed, which decides on the terms that ran.
        budget: the steps that it may take; default: its own.
    """
    program = Program(sources, MODULE_SELF, MODULE_WRAPS, budget)
    read = set(program.paths_matching(_TO_READ))
    with progress(len(read), "files read") as bar:  # half of a file when it is parsed, half when it was judged
        program.when_read = lambda path: bar.update(0.5 * (path in read))
        analysis = Analysis(program)
        found = _Search(analysis, by_hand, bar).run()
    found = with_trace(found, analysis, trace) if trace is not None and not by_hand else found
    left = found.left
    found = with_ssims(found, analysis, by_hand) if ssim or masks else found
    found = found if ssim else found._replace(left=left)
    return with_masks(found, analysis) if masks else found


class _Search:
    def __init__(self, analysis: Analysis, by_hand: Sequence[Tuple[str, int]], bar: Any) -> None:
        self.analysis, self.bar = analysis, bar
        self.by_hand: Dict[str, List[int]] = {}  # the lines that the user named, by their file
        for path, line in dict.fromkeys(by_hand):
            self.by_hand.setdefault(path, []).append(line)
        self.verdicts = Verdicts(analysis)
        self.found = Findings([], [], [], [], [], [], analysis.program)
        self.doubtful: List[Tuple[Left, Problem]] = []

    def run(self) -> Findings:
        found, program = self.found, self.analysis.program
        for module in program.matching(_TO_READ):
            self.bar.update(0.5)
            over = module.budget.why_none_left()
            if over:
                program.give_up(module.path, over)
                continue
            try:
                self._module(module)
            except RecursionError:
                program.give_up(module.path, "is nested too deeply")
        found.without(program.unreadable)
        if not (found.sites or found.patched or found.problems or self.by_hand):
            found.problems.extend(problem for _, problem in self.doubtful)
            quoted = {id(left) for left, _ in self.doubtful}
            found.left[:] = [left for left in found.left if id(left) not in quoted]
        elif not self.by_hand:
            paths = self._open()
            doubted = [(left, one) for left, one in self.doubtful if RULES[left.rule].is_doubted_beside_sites]
            found.doubts.extend(problem for left, problem in doubted if left.path in paths)
        found.unreadable.extend(program.unreadable[path] for path in sorted(program.unreadable))
        return found._replace(unsettled=self._unsettled())

    def _unsettled(self) -> FrozenSet[str]:
        """Return the files that train Gaussians, and whose loss has no term that is weighted or reported."""
        training = self.analysis.training
        above = [site.scope for site in self.found.sites]
        for function in above:  # which grows
            above += [caller for caller, _ in training.sites.get(function, ()) if caller not in above]
        paths = set() if self.by_hand else self._open() - {function.module.path for function in above}
        roots = [root for root in training.roots if root.module.path in paths]
        return frozenset(root.module.path for root in roots if self.analysis.splats.is_about(root))

    def _open(self) -> Set[str]:
        """Return the files that train, and have no term that is weighted or reported."""
        found = self.found
        entries: List[Any] = [*found.sites, *found.patched, *found.problems, *found.doubts]
        return {root.module.path for root in self.analysis.training.roots} - {entry.path for entry in entries}

    def _module(self, module: Module) -> None:
        found = self.found
        entries: List[_Entry] = []
        for function in module.scopes(bool):
            if not module.spend(len(function.text) // _TEXT):
                return
            entries += self._entries(function)
        lists: Dict[type, List[Any]] = {Site: found.sites, Problem: found.problems, Left: found.left}
        for _, entry in sorted(entries, key=lambda item: item[0]):
            is_patched = isinstance(entry, Left) and entry.reason == "patched"
            kept: List[Any] = found.patched if is_patched else lists[type(entry)]
            kept.append(entry)

    def _entries(self, function: Function) -> Iterator[_Entry]:
        """Yield the verdict on each L1 in a function, with its place."""
        yield from self._of_forms(function)
        if self.by_hand:
            yield from self._of_named_lines(function)
        for node in patched_nodes(self.analysis.program, function):
            yield function.place(node), Left.at(function, function.place(node), "patched")
        callbacks, decide = self.analysis.callbacks, self.verdicts
        found = [(form, decide.decide_callback(function, form)) for form in callbacks.assigned_in(function)]
        found += [(form, decide.callable(function, form)) for form in callbacks.registered_in(function)]
        for form, verdict in found:
            place = function.place(form.node)
            if not self.by_hand or self._is_chosen(function, place):
                yield place, verdict

    def _of_forms(self, function: Function) -> Iterator[_Entry]:
        meant = self._meant(function) if self.by_hand else []
        for form in self.analysis.forms.in_function(function):
            if not function.module.spend(min(_RULES, function.flow.steps)):
                return
            place = function.place(form.node)
            chosen = form in meant
            verdict = self.verdicts.decide(function, form, place, chosen)
            if isinstance(verdict, Left):
                doubt = self.verdicts.doubt(function, form, place, verdict)
                self.doubtful += [(verdict, doubt)] if doubt is not None else []
            elif self.by_hand and not chosen:
                verdict = Left.at(function, place, "not chosen")
            if not (isinstance(verdict, Left) and self._is_noise(form)):
                yield place, verdict

    def _meant(self, function: Function) -> List[Form]:
        """Return the terms on named lines: of several on one those that no rule skips, or not as of another kind."""
        kinds, meant = {rule.id for rule in KINDS}, []
        places = [(f, function.place(f.node)) for f in self.analysis.forms.in_function(function)]
        for line in self.by_hand.get(function.module.path, ()):
            named = [form for form, place in places if place.line <= line <= place.last_line]
            why = [first(Term(self.analysis, function, form)) for form in named] if len(named) > 1 else []
            clear = [form for form, evidence in zip(named, why) if evidence is None]
            known = [form for form, evidence in zip(named, why) if evidence and evidence.rule not in kinds]
            meant += clear or known or named
        return meant

    def _is_noise(self, form: Form) -> bool:
        """Return whether a skipped term is an absolute difference that is no loss: of angles, of sizes."""
        return form.callee is None and form.makes != "mean" and not self.analysis.training.includes(form.node)

    def _of_named_lines(self, function: Function) -> Iterator[_Entry]:
        """Yield the first call of two arguments on a line that the user named and that has no other term."""
        known = [function.place(form.node) for form in self.analysis.forms.in_function(function)]
        for call in function.flow.calls:
            place, (values, keywords, starred) = function.place(call), arguments(call)
            if not self._is_chosen(function, place) or len(values) != 2 or keywords or starred:
                continue
            if not any(place.line <= other.last_line and other.line <= place.last_line for other in known):
                if NO_L1.search(call_name(call)):
                    why = f"{call_name(call)} is by its name no L1, which alone is weighted"
                    yield place, Problem.at(function, place, why, "name the line of the L1")
                else:
                    form = Called(call, call, values[0], values[1], call.func)
                    yield place, self.verdicts.decide(function, form, place, True)
                return

    def _is_chosen(self, function: Function, place: Place) -> bool:
        return any(place.line <= line <= place.last_line for line in self.by_hand.get(function.module.path, ()))
