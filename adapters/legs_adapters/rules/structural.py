"""Find the SSIM terms of a checkout's training steps that legs_loss.ssim can compute; and every other, with the reason.

The L1 terms are found before, and the findings here do not change them: they use a backward slice of their own.
"""

from __future__ import annotations

from typing import Iterator, List, Sequence, Set, Tuple, Union

from legs_adapters.code.module import Function, Module
from legs_adapters.code.parsing import Place
from legs_adapters.rules.analysis import Analysis
from legs_adapters.rules.order import SSIM, first
from legs_adapters.rules.rule import Term
from legs_adapters.terms.findings import Findings, Left, Site
from legs_adapters.terms.kinds.structural import Structural
from legs_adapters.terms.patched import patched_nodes
from legs_adapters.terms.ssim import STRUCTURAL
from legs_adapters.terms.writing import PACKAGE

__all__ = ["with_ssims"]


def with_ssims(found: Findings, by_hand: Sequence[Tuple[str, int]]) -> Findings:
    """Return findings with the SSIM terms of their program; without an L1 term there is nothing to add them to.

    ``by_hand`` as for the L1 terms.
    """
    if not (found.sites or found.patched or by_hand):
        return found
    finder = _Finder(Analysis(found.program, STRUCTURAL), found, by_hand)
    for module in found.program.matching(STRUCTURAL):
        finder.look_at(module)
    inside = {site.scope for site in finder.sites}
    left = [entry for entry, callees in finder.left if not callees & inside]  # it calls what has the term
    return found._replace(
        sites=sorted([*found.sites, *finder.sites], key=_where),
        left=sorted([*found.left, *left], key=_where),
        patched=sorted([*found.patched, *finder.patched], key=_where),
    )


def _where(entry: Union[Site, Left]) -> Tuple[str, int]:
    return entry.path, entry.line


class _Finder:
    def __init__(self, analysis: Analysis, found: Findings, by_hand: Sequence[Tuple[str, int]]) -> None:
        self.analysis = analysis
        self.by_hand = set(by_hand)
        self.taken = [(site.path, site.scope.place(site.form.node)) for site in found.sites]
        self.sites: List[Site] = []
        self.left: List[Tuple[Left, Set[object]]] = []
        self.patched: List[Left] = []

    def look_at(self, module: Module) -> None:
        """Take in the terms of a file."""
        before = len(self.sites), len(self.left), len(self.patched)
        try:
            for function in module.scopes(STRUCTURAL.search):
                for form, place in self._forms(function):
                    self._decide(function, form, place)
                nodes = patched_nodes(self.analysis.program, function, (f"{PACKAGE}.ssim",))
                self.patched += [Left.at(function, function.place(node), "patched") for node in nodes]
        except ValueError:  # it cannot be written back exactly
            for entries, count in zip((self.sites, self.left, self.patched), before):
                del entries[count:]  # type: ignore[attr-defined]

    def _forms(self, function: Function) -> Iterator[Tuple[Structural, Place]]:
        for call in function.flow.calls:
            form = Structural.find(self.analysis.forms.functions, function, call)
            if isinstance(form, Structural):
                yield form, function.place(call)

    def _decide(self, function: Function, form: Structural, place: Place) -> None:
        evidence = first(Term(self.analysis, function, form), SSIM)
        if evidence is not None:
            references = self.analysis.program.resolve(function, form.call.func)
            self.left.append((Left.at(function, place, evidence), {r.target for r in references}))
        elif self._is_free(function, place):
            why = self.analysis.ssims.proof(function, form).reason
            stands = (function.module.path, place.line, place.column, place.last_line)
            self.sites.append(Site(*stands, form, False, "", why, function))
        else:
            self.left.append((Left.at(function, place, "not chosen"), set()))

    def _is_free(self, function: Function, place: Place) -> bool:
        """Return whether the term may be edited: the user named it, or named none, and it is in no other edit."""
        path = function.module.path
        chosen = any(path == name and place.line <= line <= place.last_line for name, line in self.by_hand)
        within = any(path == name and taken.start <= place.start < taken.end for name, taken in self.taken)
        return (chosen or not self.by_hand) and not within
