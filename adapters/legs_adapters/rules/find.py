"""Find the photometric L1 terms of a checkout's training steps; and every other L1, with the reason why it is skipped.

A site is an L1 between a rendering and the ground truth whose value reaches a backward pass. Everything is decided from
the syntax tree; a term that cannot be decided becomes a problem that needs a manual edit, never a guess.
"""

from __future__ import annotations

import re
from typing import Iterable, Iterator, List, Mapping, Optional, Sequence, Tuple, Union

from legs_adapters.code.module import Function, Module
from legs_adapters.code.parsing import Place
from legs_adapters.code.sources import Source
from legs_adapters.code.syntax import arguments
from legs_adapters.lexicon.words import SPEAKS_OF_L1, STRUCTURAL
from legs_adapters.rules.analysis import Analysis
from legs_adapters.rules.doubts import Doubt, Doubts
from legs_adapters.rules.masks import with_masks
from legs_adapters.rules.structural import with_ssims
from legs_adapters.rules.verdict import Verdicts
from legs_adapters.terms.findings import Findings, Left, Problem, Site
from legs_adapters.terms.kinds.called import Called
from legs_adapters.terms.kinds.fused import fused_losses
from legs_adapters.terms.patched import patched_nodes
from legs_adapters.upstreams import registered

__all__ = ["find"]

_Entry = Tuple[Place, Union[Site, Left, Problem]]

_TEXT = 50  # letters of a text that are searched in a step
_MAY_HAVE_L1 = re.compile(SPEAKS_OF_L1.pattern + r"|\bunweighted\(")


def find(
    sources: Iterable[Source],
    by_hand: Sequence[Tuple[str, int]] = (),
    unread: Optional[Mapping[str, str]] = None,
    ssim: bool = False,
    masks: bool = False,
) -> Findings:
    """Find the photometric terms of a checkout.

    Args:
        sources: its files.
        by_hand: (path, line) of the L1 terms that the user named as sites; nothing else is a site then.
        unread: by path, the text of files that are ignored or cannot be read.
        ssim: find the SSIM terms, too.
        masks: find where their renderings are masked, too.
    """
    finder = _Finder(Analysis.of(sources, unread), by_hand)
    found = finder.run()
    found = with_ssims(found, by_hand) if ssim else found
    return with_masks(found, finder.analysis) if masks else found


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
        self.found.without(self.analysis.program.unreadable)
        if not (self.found.sites or self.found.patched or self.found.problems or self.by_hand):
            self.found.problems.extend(doubt.problem for doubt in self.doubtful)
            quoted = {(problem.path, problem.line) for problem, _ in self.doubtful}
            self.found.left[:] = [left for left in self.found.left if (left.path, left.line) not in quoted]
        elif not self.by_hand:
            self.found.doubts.extend(doubt.problem for doubt in self.doubtful if self._trains_alone(doubt))
        unreadable = self.analysis.program.unreadable
        self.found.unreadable.extend(unreadable[path] for path in sorted(unreadable))
        return self.found

    def _trains_alone(self, doubt: Doubt) -> bool:
        """Return whether its file trains, and has no term that is weighted or reported as a problem."""
        settled = {site.path for site in self.found.sites} | {entry.path for entry in self.found.patched}
        settled |= {problem.path for problem in self.found.problems}
        path = doubt.problem.path
        trains = any(root.module.path == path for root in self.analysis.training.roots)
        return trains and doubt.is_told_beside_sites and path not in settled

    def _module(self, module: Module) -> None:
        over = module.budget.why_none_left()
        if over:
            self.analysis.program.give_up(module.path, over)
            return
        entries: List[_Entry] = []
        patched: List[Left] = []
        try:
            for function in module.scopes(lambda text: self.analysis.prospects.of(text) or STRUCTURAL.search(text)):
                if not module.spend(len(function.text) // _TEXT):
                    return
                entries += self._entries(function)
                nodes = patched_nodes(self.analysis.program, function)
                patched += [Left.at(function, function.place(node), "patched") for node in nodes]
        except ValueError:
            self.analysis.program.give_up(module.path, "cannot be written back exactly")
            return
        except RecursionError:
            self.analysis.program.give_up(module.path, "is nested too deeply")
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
        """Yield the verdict on each L1 in a function, with its place."""
        # Elsewhere an L1 could only be reached through two names, and nothing trains on it.
        if self.analysis.prospects.near(function.text) or self.analysis.training.touches(function):
            yield from self._of_forms(function)
            if not self.by_hand:
                yield from fused_losses(self.analysis.program, self.analysis.training, function)
        if self.by_hand:
            yield from self._of_named_lines(function)
        yield from self._of_callables(function)
        self.doubtful.extend(self.doubts.of_uncalled(function))

    def _of_forms(self, function: Function) -> Iterator[_Entry]:
        for form in self.analysis.forms.of(function):
            if not function.module.spend(function.flow.steps):  # some rules look at all of it
                return
            place = function.place(form.node)
            chosen = self._is_chosen(function, place)
            verdict = self.verdicts.of(function, form, place, chosen)
            if isinstance(verdict, Left) and self.doubts.is_doubtful(function, form, verdict):
                self.doubtful.append(self.doubts.of(function, form, place, verdict))
            if self.by_hand and not chosen and not isinstance(verdict, Left):
                verdict = Left.at(function, place, "not chosen")
            if not (isinstance(verdict, Left) and self.doubts.is_noise(function, form, verdict)):
                yield place, verdict

    def _of_named_lines(self, function: Function) -> Iterator[_Entry]:
        """Yield the first call of two arguments on a line that the user named and that has no other term."""
        taken = [function.place(form.node) for form in self.analysis.forms.of(function)]
        for call in function.flow.calls:
            place, (values, keywords, starred) = function.place(call), arguments(call)
            if not self._is_chosen(function, place) or len(values) != 2 or keywords or starred:
                continue
            if not any(place.line <= other.last_line and other.line <= place.last_line for other in taken):
                form = Called(call, call, values[0], values[1], call.func)
                yield place, self.verdicts.of(function, form, place, True)
                return

    def _of_callables(self, function: Function) -> Iterator[_Entry]:
        verdicts = self.verdicts
        found = [
            (callback.form, verdicts.of_callback(function, callback))
            for callback in self.analysis.callbacks.of(function)
        ]
        for call in function.flow.calls if registered.MENTIONED.search(function.text) else ():
            forms = registered.forms_of(self.analysis.program, function, call)
            found += [(form, verdicts.callable(function, form)) for form in forms]
        for form, verdict in found:
            place = function.place(form.node)
            if not self.by_hand or self._is_chosen(function, place):
                yield place, verdict

    def _is_chosen(self, function: Function, place: Place) -> bool:
        path = function.module.path
        return any(path == chosen and place.line <= line <= place.last_line for chosen, line in self.by_hand)
