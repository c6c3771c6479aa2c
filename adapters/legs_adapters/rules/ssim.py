"""Find the SSIM terms of a checkout's training steps that legs_loss.ssim can compute; and every other, with the reason.

The L1 terms are found before, and the findings here do not change them: they use a backward slice of their own.
"""

from __future__ import annotations

from typing import Iterator, List, Sequence, Tuple, Union

from legs_adapters.code.module import Function
from legs_adapters.code.parsing import Place
from legs_adapters.lexicon.words import STRUCTURAL
from legs_adapters.rules.analysis import Analysis
from legs_adapters.rules.order import SSIM, first
from legs_adapters.rules.rule import Term
from legs_adapters.terms.findings import Findings, Left, Site
from legs_adapters.terms.kinds.ssim import Ssim
from legs_adapters.terms.patched import patched_nodes
from legs_adapters.terms.writing import PACKAGE

__all__ = ["with_ssims"]

_Entry = Union[Site, Left]


def with_ssims(found: Findings, by_hand: Sequence[Tuple[str, int]]) -> Findings:
    """Return findings with the SSIM terms of their program; without an L1 term there is nothing to add them to.

    ``by_hand`` as for the L1 terms.
    """
    if not (found.sites or found.patched or by_hand):
        return found
    analysis = Analysis(found.program, STRUCTURAL)
    entries = list(_entries(analysis, found, by_hand))
    sites = [entry for entry in entries if isinstance(entry, Site)]
    left = [entry for entry in entries if isinstance(entry, Left) and entry.reason != "patched"]
    patched = [entry for entry in entries if isinstance(entry, Left) and entry.reason == "patched"]
    return found.with_more(sites=sites, left=left, patched=patched)


def _entries(analysis: Analysis, found: Findings, by_hand: Sequence[Tuple[str, int]]) -> Iterator[_Entry]:
    """Yield the verdict on each SSIM, but for those inside the edit of an L1 and for the bodies of SSIM functions."""
    edited = [(site.path, site.scope.place(site.form.node)) for site in found.sites]
    for module in found.program.matching(STRUCTURAL):
        entries: List[_Entry] = []
        try:
            for function in module.scopes(STRUCTURAL.search):
                nodes = patched_nodes(analysis.program, function, (f"{PACKAGE}.ssim",))
                entries += [Left.at(function, function.place(node), "patched") for node in nodes]
                for call in function.flow.calls if not analysis.ssims.is_ssim(function) else ():
                    form, place = Ssim.find(analysis.forms.functions, function, call), function.place(call)
                    within = any(module.path == path and at.start <= place.start < at.end for path, at in edited)
                    if form is not None and not within:
                        entries += _verdict(analysis, function, form, place, by_hand)
        except ValueError:
            continue  # it cannot be written back exactly
        yield from entries


def _verdict(
    analysis: Analysis, function: Function, form: Ssim, place: Place, by_hand: Sequence[Tuple[str, int]]
) -> Iterator[_Entry]:
    evidence = first(Term(analysis, function, form), SSIM)
    chosen = not by_hand or any(
        function.module.path == path and place.line <= line <= place.last_line for path, line in by_hand
    )
    proven = analysis.ssims.proven(function, form)
    if evidence is not None or not chosen:
        is_own = STRUCTURAL.search(function.name) is not None  # of the codebase's SSIM, whose calls are decided
        if evidence is None or not (is_own and evidence.rule == "ssim-unproven"):
            yield Left.at(function, place, evidence or "not chosen")
    elif proven is not None:
        yield Site.at(function, form, f"{proven.module.path}:{proven.line} is the SSIM of 3DGS")
