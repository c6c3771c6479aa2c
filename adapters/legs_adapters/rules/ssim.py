"""Find the SSIM terms beside a weighted L1 that legs_loss.ssim can compute; and every other there, with the reason."""

from __future__ import annotations

from typing import Iterator, List, Sequence, Tuple, Union

from legs_adapters.code.module import Function
from legs_adapters.lexicon.words import STRUCTURAL
from legs_adapters.rules.analysis import Analysis
from legs_adapters.rules.causes.ssim import UnprovenSsim
from legs_adapters.tensors.gradients import no_grad_around
from legs_adapters.terms.findings import Evidence, Findings, Left, Site
from legs_adapters.terms.kinds.ssim import Ssim
from legs_adapters.terms.patched import patched_nodes
from legs_adapters.terms.ssim import proven_ssim
from legs_adapters.terms.writing import PACKAGE


def with_ssims(found: Findings, analysis: Analysis, by_hand: Sequence[Tuple[str, int]]) -> Findings:
    """Return findings with the SSIM terms of the functions that have a weighted L1, or were named by hand."""
    weighted = {site.scope for site in found.sites}
    entries: List[Union[Site, Left]] = []
    for module in found.program.matching(STRUCTURAL):
        is_chosen = any(path == module.path for path, _ in by_hand)
        for function in module.scopes(STRUCTURAL.search):
            if is_chosen or function in weighted or patched_nodes(analysis.program, function):
                entries += _in_function(analysis, function, found, by_hand)
    sites = [entry for entry in entries if isinstance(entry, Site)]
    left = [entry for entry in entries if isinstance(entry, Left) and entry.reason != "patched"]
    patched = [entry for entry in entries if isinstance(entry, Left) and entry.reason == "patched"]
    return found.with_more(sites=sites, left=left, patched=patched)


def _in_function(
    analysis: Analysis, function: Function, found: Findings, by_hand: Sequence[Tuple[str, int]]
) -> Iterator[Union[Site, Left]]:
    """Yield the verdict on each SSIM, but for those inside the edit of an L1."""
    edited = [function.place(site.form.node) for site in found.sites if site.scope is function]
    for node in patched_nodes(analysis.program, function, (f"{PACKAGE}.ssim",)):
        yield Left.at(function, function.place(node), "patched")
    for call in function.flow.calls:
        form, place = Ssim.find(analysis.forms.functions, function, call), function.place(call)
        if form is None or any(at.start <= place.start < at.end for at in edited):
            continue
        proven = proven_ssim(analysis.program, function, form)
        named = [(function.module.path, line) for line in range(place.line, place.last_line + 1)]
        if proven is None:
            yield Left.at(function, place, Evidence(UnprovenSsim.id, UnprovenSsim.reason, [(function, form.node)]))
        elif by_hand and not set(named).intersection(by_hand):
            yield Left.at(function, place, "not chosen")
        elif no_grad_around(function, call):
            yield Left.at(function, place, "evaluation")
        else:
            yield Site.at(function, form, f"{proven.module.path}:{proven.place(proven.node).line} is the SSIM of 3DGS")
