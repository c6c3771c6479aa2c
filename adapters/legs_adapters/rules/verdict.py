"""Decide on one form: a site to weight, a term that a rule skips, or a problem that needs a manual edit."""

from __future__ import annotations

import ast
import builtins
from typing import List, NamedTuple, Optional, Tuple

from legs_adapters.code.calls import values_of
from legs_adapters.code.module import CALLED, Function
from legs_adapters.code.parsing import Place
from legs_adapters.code.reaching import Definition
from legs_adapters.code.syntax import (
    attribute_chain,
    call_name,
    given,
    indices,
    key_of,
    one_line,
    same,
    words,
    words_in,
)
from legs_adapters.lexicon.depiction import parts_of
from legs_adapters.lexicon.meaning import UNKNOWN, swapped
from legs_adapters.lexicon.names import is_of_other_framework, kind_of_words
from legs_adapters.lexicon.ways import PHOTOGRAPH
from legs_adapters.lexicon.words import DATA, FILES, MESH, PERCEPTUAL, TRACKING, WARPED
from legs_adapters.rules.analysis import Analysis
from legs_adapters.rules.order import RULES, first
from legs_adapters.rules.rule import Term
from legs_adapters.rules.uses import uses_of
from legs_adapters.tensors.operations import KEEPS_PICTURES, MODULES, OF_IMAGES
from legs_adapters.terms.error_maps import is_measured, reads_of
from legs_adapters.terms.findings import Evidence, Left, Problem, Site
from legs_adapters.terms.form import Form
from legs_adapters.terms.kinds.callback import PassedByName
from legs_adapters.terms.kinds.indirect import Indirect
from legs_adapters.terms.kinds.reread import Reread
from legs_adapters.terms.sides import is_of_numbers, is_role, same_root
from legs_adapters.terms.text import Text

_OF_DIFFERENCE = "as one absolute difference times the photograph's weight map, with each mask and threshold as it is"
OF_PIXELS = "weight the L1 of the whole images, before pixels are picked or flattened"

_MOST = 100  # expressions that a photograph is followed through


class _ByHand(NamedTuple):
    """The reason that a term is not edited, and what to do in words; none where the user's word would settle it."""

    reason: str
    advice: str = ""


class Verdicts:
    """Decide on the forms of one program."""

    def __init__(self, analysis: Analysis) -> None:
        self.analysis = analysis

    def decide(self, function: Function, form: Form, place: Place, by_hand: bool) -> Site | Left | Problem:
        """Return the verdict on a form; ``by_hand`` where the user named it as the loss."""
        term = Term(self.analysis, function, form)
        verdict = self._verdict(term, place, by_hand)
        return self.problem(term, place, verdict.reason) if isinstance(verdict, _ByHand) else verdict

    def _verdict(self, term: Term, place: Place, by_hand: bool) -> Site | Left | _ByHand:
        function, form = term.function, term.form
        evidence = None if by_hand else first(term)
        if evidence is not None:
            return Left.at(function, place, evidence)
        why = self._why_by_hand(term, by_hand)
        if why is not None:
            return why
        uses = uses_of(self.analysis, term)
        others = [use for use in uses if use.other is not None]
        is_loss = len(others) < len(uses)  # some call is, by reading
        if others and not is_loss and not by_hand:
            return Left.at(function, place, others[0].other or "")
        unknown = [use for use in uses if not use.is_known]
        if unknown and (len(unknown) < len(uses) or len({use.target for use in uses}) > 1):  # one body serves several
            odd = next((use for use in unknown if use.target != uses[0].target), unknown[0])
            where = f"{one_line(odd.call)} at {odd.left.path}:{odd.left.line}"
            reason = f"nothing shows that {where} is the loss, and other calls share this body"
            return _ByHand(reason, "give the loss a function of its own, and weight the L1 in that one")
        loss, others_read = reads_of(self.analysis.training, function, form)
        if others_read and not loss:
            return Left.at(function, place, Evidence("untrained", "untrained", term.here))
        if others_read:
            is_one = len(loss) == 1 and isinstance(function.flow.reaching(loss[0]), Definition)
            if not is_one or loss[0] in others_read or not function.flow.unchanged(form.first, form.second):
                reason = f"{one_line(form.node)} has other uses than the loss"
                return _ByHand(reason, "weight a second error map, for the loss, and leave this one to its other uses")
            form = Reread(loss[0], form.call, form.first, form.second)
        is_swapped = term.target is term.pair.first
        site = Site.at(function, form, self._why_photograph(term), is_swapped, term.pair.selection)
        return site._replace(unweighted=tuple(others) if is_loss else ())

    def decide_callback(self, holder: Function, form: PassedByName) -> Site | Left:
        """Return the verdict on an L1 function that is passed by name, from the arguments of its call."""
        term = Term(self.analysis, form.caller or holder, form)
        term.here = [(holder, form.node)]
        evidence = first(term)
        if evidence is None and swapped(term.pair.a, term.pair.b) is not False:
            evidence = Evidence("unknown", "unknown", term.here)
        if evidence is not None:
            return Left.at(holder, holder.place(form.node), evidence)
        return self.callable(holder, form)

    @staticmethod
    def callable(function: Function, form: PassedByName) -> Site:
        """Return a function that is passed by name as a site."""
        caller, sides = form.caller, f"{one_line(form.first)} and {one_line(form.second)}, the photograph"
        at = "" if caller is None else f", at {caller.module.path}:{caller.place(form.call).line}"
        return Site.at(function, form, f"passed by name, and called with {sides}{at}")

    def doubt(self, function: Function, form: Form, place: Place, left: Left) -> Optional[Problem]:
        """Return the warning of a skipped term that may be the loss, if nothing else is found; None of any other."""
        term = Term(self.analysis, function, form)
        rule = RULES.get(left.rule)
        text = function.module.text
        is_numpy = form.callee is None and "numpy" in text and "torch" not in text
        if rule is None or is_numpy or is_of_other_framework(text):
            return None
        if not rule.may_be_loss(term) or is_measured(function, form) or same_root(form):
            return None
        names = [*dict(term.names_around), *getattr(self.analysis.program.owner_of(function), "methods", ())]
        other = (PERCEPTUAL | WARPED | MESH) & words_in(form.node).union(*map(words, names))
        kinds, roles = zip(term.pair.a, term.pair.b)
        pictures = "image" in kinds or (function.name in CALLED and all(map(is_role, term.sides)))
        if other or not pictures or TRACKING & {*words(function.name)} or (rule.needs_target and "target" not in roles):
            return None
        return self.problem(term, place, f"nothing shows that this is the loss: {rule.sentence()}")

    def problem(self, term: Term, place: Place, reason: str) -> Problem:
        """Return a term as a problem, with the advice: what ``--site`` writes there, or words."""
        named = self._verdict(term, place, by_hand=True)
        if isinstance(named, Site) and named.line == place.line:
            text = Text(self.analysis.program.sources[named.path], named.scope)
            return Problem.at(term.function, place, reason, named.form.advice(text, named.writing()), by_site=True)
        words = named.advice if isinstance(named, _ByHand) else "weight the calls of it that are the loss"
        return Problem.at(term.function, place, reason, words)

    def _why_by_hand(self, term: Term, by_hand: bool) -> Optional[_ByHand]:
        """Return why no edit gives the images their weights; None where one may."""
        untold = "" if by_hand else self._untold(term)
        if untold:
            return _ByHand(untold)
        if term.has_rows:
            return _ByHand("the sides are lists of pixels: a weight map needs whole images", OF_PIXELS)
        if any(is_of_numbers(term.function, side) for side in term.sides):
            return _ByHand("a side is made of numbers", "leave it: it compares with no photograph")
        if isinstance(term.form, Indirect) and term.form.difference is not None:
            why = f"{one_line(term.form.difference)} may change before its absolute value is taken"
            return _ByHand(why, _OF_DIFFERENCE)
        return None

    def _untold(self, term: Term) -> str:
        """Return what nothing shows of a term, and the user's word would; "" where all is shown."""
        pair, target, prediction = term.pair, one_line(term.target), one_line(term.prediction)
        if swapped(pair.a, pair.b) is None:
            sides = f"{one_line(pair.first)} and {one_line(pair.second)}"
            return f"cannot tell which of {sides} is the rendering and which the photograph"
        if "target" not in (pair.a.role, pair.b.role):
            return f"nothing shows that {target} is a photograph"
        if UNKNOWN in (pair.a, pair.b):
            return f"nothing shows that {prediction} is a rendering"
        made = self._unknown_maker(term.function, term.target)
        if made is not None:
            return f"nothing shows what {one_line(made)} makes of the photograph"
        is_told = not self._is_unknown_entry(term.function, term.prediction)
        return "" if is_told else f"nothing shows which pictures {prediction} takes"

    def _unknown_maker(self, function: Function, target: ast.expr) -> Optional[ast.Call]:
        """Return what makes a target of a photograph, ``teacher(photo)``, where nothing shows what that does."""
        meaning = self.analysis.meanings.meaning
        work: List[Tuple[Function, ast.AST]] = [(function, target)]
        for where, node in work:  # which grows
            parts = [*where.flow.assigned(node), *parts_of(node)]
            returned: List[Tuple[Function, ast.AST]] = []
            if isinstance(node, ast.Subscript):
                parts = [node.value]
            elif isinstance(node, ast.Call):
                handed = [arg.value for arg in given(node) if not FILES & words_in(arg.value)]
                if PHOTOGRAPH in [meaning(where, each) for each in handed] and self._is_unknown(where, node):
                    return node
                returned = values_of(self.analysis.program, where, node)
                parts = [*handed, *attribute_chain(node.func)] if call_name(node) in KEEPS_PICTURES else []
            elif isinstance(node, ast.BinOp):  # photo * segment(photo): a mask
                shown = [part for part in parts if meaning(where, part) == PHOTOGRAPH]
                parts = [part for part in parts if len(shown) < 2 or not isinstance(part, ast.Call)]
            pictures = [(where, part) for part in parts if meaning(where, part).kind in (None, "image")]
            goes_on = where.module.spend(1 + len(parts)) and len(work) < _MOST
            work += [each for each in pictures + returned if each not in work] if goes_on else []
        return None

    def _is_unknown(self, function: Function, call: ast.Call) -> bool:
        """Return whether a call is of what neither the checkout defines nor a known library of images."""
        root = list(attribute_chain(call.func))[-1]
        name = root.id if isinstance(root, ast.Name) else ""
        if call_name(call) in KEEPS_PICTURES or (DATA | {"self"}) & set(words(name)):
            return False  # a camera's own method, or an inherited one
        found = self.analysis.program.resolve(function, call.func)
        libraries = [str(each.target) for each in found if each.kind in ("external", "made by")]
        if found:
            return len(libraries) == len(found) and not all(map(OF_IMAGES.match, libraries))
        return name not in MODULES and not hasattr(builtins, name)

    def _is_unknown_entry(self, function: Function, side: ast.AST) -> bool:
        """Return whether it is under each key in turn, or one in another that no word tells: ``pkg["out"]["D"]``."""
        entry = function.flow.value_of(side) or side
        if not isinstance(entry, ast.Subscript):
            return False
        named = [kind_of_words(key) for key in map(key_of, attribute_chain(entry)) if isinstance(key, str)]
        if len(named) > 1 and "image" not in named and self.analysis.meanings.meaning(function, entry).kind is None:
            return True
        last = indices(entry)[-1:]  # package[name] of `for name in package`
        looped = [made.value for index in last for made in function.flow.reaching(index)]
        holders = [part for value in looped if value is not None for part in attribute_chain(value)]
        return any(same(entry.value, holder) for holder in holders)

    def _why_photograph(self, term: Term) -> str:
        """Return what shows that a side is the photograph."""
        name = one_line(term.target)
        if self.analysis.meanings.origin(term.function, term.target).role == "target":
            is_place = isinstance(term.target, (ast.Name, ast.Attribute, ast.Subscript, ast.Call))
            return f"{name} is {'' if is_place else 'made from '}the photograph"
        where = "a parameter, " if term.function.is_parameter(term.target) else ""
        return f"{name} is {where}the photograph by its name"
