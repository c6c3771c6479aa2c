"""The photometric L1 terms of a checkout's training steps; and every other L1 in it, with the reason it was left.

A site is an L1 between a rendering and the ground truth whose value reaches a backward pass. Everything is decided from
the tree (see flow, training, l1, meaning); what cannot be decided is a problem that a person settles, never a guess.
"""

from __future__ import annotations

import re
from typing import Iterable, Iterator, List, Mapping, Optional, Sequence, Tuple, Union

import libcst as cst

from legs_adapters.findings import Findings, Kept, Left, Problem, Site
from legs_adapters.reading.absolute import abs_argument
from legs_adapters.reading.beside import STRUCTURAL
from legs_adapters.reading.calls import sure_calls
from legs_adapters.reading.handed import Handed, HandedOver
from legs_adapters.reading.l1 import Form, Forms
from legs_adapters.reading.layout import is_channels_last, lies_last
from legs_adapters.reading.meaning import Meanings
from legs_adapters.reading.module import Function, Module
from legs_adapters.reading.own import is_l1_function, own_shape
from legs_adapters.reading.pair import is_role, pair_of, same_root, swapped
from legs_adapters.reading.parts import Place
from legs_adapters.reading.picked import is_rows, picked_from, without_rows
from legs_adapters.reading.program import Program
from legs_adapters.reading.provenance import View, Views
from legs_adapters.reading.reasons import Reasons
from legs_adapters.reading.repo import Source
from legs_adapters.reading.run_time import chosen_at_run_time
from legs_adapters.reading.shared import is_asked, is_huber, is_measured, shared_of, unchanged_at
from legs_adapters.reading.syntax import arguments, call_name, code, dotted, one_line, same, walk_expressions, words
from legs_adapters.reading.training import Training
from legs_adapters.reading.uses import Use, Uses, detaches
from legs_adapters.reading.vocabulary import kind_of_words
from legs_adapters.upstreams import registered

__all__ = ["find"]

Entry = Tuple[Place, Union[Site, Left, Problem]]

_FORWARD = ("forward", "__call__")
_PATCHED = ("legs_loss.l1_loss", "legs_loss.unweighted")
_NOT_OF_SPLATS = ("other", "definition")
_PICTURES = {"depth", "normals", "features", "flow", "mask"}  # what else is compared in a training step
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
    return _Finder(Program(sources, unread), by_hand).run()


class _Finder:
    def __init__(self, program: Program, by_hand: Sequence[Tuple[str, int]]) -> None:
        self.program = program
        self.by_hand = set(by_hand)
        self.training = Training(program)
        self.meanings = Meanings(program, self.training)
        self.views = Views(program)
        self.forms = Forms(program)
        self.reasons = Reasons(program, self.training, self.meanings, self.forms)
        self.uses = Uses(program, self.training, self.meanings, self.reasons)
        self.handed = Handed(program, self.training, self.forms)
        self.found = Findings([], [], [], [], [], [], program)
        self.doubtful: List[Problem] = []

    def run(self) -> Findings:
        for module in self.program.matching(_MAY_HAVE_L1):
            self._module(module)
        if not (self.found.sites or self.found.patched or self.found.problems or self.by_hand):
            self.found.problems.extend(self.doubtful)
            quoted = {(problem.path, problem.line) for problem in self.doubtful}
            self.found.left[:] = [left for left in self.found.left if (left.path, left.line) not in quoted]
        elif not self.by_hand:
            self.found.doubts.extend(doubt for doubt in self.doubtful if self._trains_alone(doubt))
        self.found.unreadable.extend(self.program.unreadable[path] for path in sorted(self.program.unreadable))
        return self.found

    def _trains_alone(self, doubt: Problem) -> bool:
        """Whether its file trains something, in which nothing was weighted or quoted."""
        settled = {site.path for site in self.found.sites} | {entry.path for entry in self.found.patched}
        settled |= {problem.path for problem in self.found.problems}
        trains = any(root.module.path == doubt.path for root in self.training.roots)
        about = any(f"({word})" in doubt.reason for word in _NOT_OF_SPLATS)
        return trains and not about and doubt.path not in settled

    def _module(self, module: Module) -> None:
        entries: List[Entry] = []
        patched: List[Left] = []
        try:
            for function in module.scopes(lambda text: self.program.prospects.of(text) or STRUCTURAL.search(text)):
                entries += self._entries(function)
                patched += self._patched(function)
        except ValueError:
            self.program.give_up(module.path, "cannot be written back exactly")
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

    def _entries(self, function: Function) -> Iterator[Entry]:
        """What is to be said of each L1 in a function, with where it is."""
        # Elsewhere an L1 could only be one by a name of a name, and nothing trains on it.
        if self.program.prospects.near(function.text) or self.training.touches(function):
            yield from self._of_forms(function)
            if not self.by_hand:
                yield from self._of_kernels(function)
        if STRUCTURAL.search(function.text):
            yield from self._of_chosen(function)
        yield from self._of_callables(function)
        self._look_at_names(function)

    def _of_forms(self, function: Function) -> Iterator[Entry]:
        for form in self.forms.of(function):
            place = function.place(form.node)
            chosen = self._is_chosen(function, place)
            verdict = self._verdict(function, form, place, chosen)
            if isinstance(verdict, Left) and self._is_doubtful(function, form, verdict):
                self.doubtful.append(self._doubt(function, form, place, verdict.reason))
            if self.by_hand and not chosen and not isinstance(verdict, Left):
                verdict = self._left(function, place, "not chosen")
            if not (isinstance(verdict, Left) and self._is_noise(function, form, verdict)):
                yield place, verdict

    def _of_chosen(self, function: Function) -> Iterator[Entry]:
        for form in chosen_at_run_time(self.program, self.training, function, self.forms.of(function)):
            place = function.place(form.node)
            if self._is_chosen(function, place):
                yield place, self._verdict(function, form, place, True)
            elif not self.by_hand:
                yield place, self._of_any(function, form, place)

    def _of_kernels(self, function: Function) -> Iterator[Entry]:
        for call in function.flow.calls:
            if self._is_kernel(function, call):
                place = function.place(call)
                yield place, self._of_kernel(function, call, place)

    def _of_callables(self, function: Function) -> Iterator[Entry]:
        callables = [
            (entry.form, self._why_not_handed(function, entry)) for entry in self.handed.by_holder.get(function, ())
        ]
        for call in function.flow.calls if registered.MENTIONED.search(function.text) else ():
            callables += [(form, None) for form in registered.forms_of(self.program, function, call)]
        for form, reason in callables:
            place = function.place(form.node)
            if not self.by_hand or self._is_chosen(function, place):
                yield place, self._left(function, place, reason) if reason else self._callable(function, form, place)

    def _look_at_names(self, function: Function) -> None:
        """Note torch's L1 under a name that no call in sight uses: ``base = F.l1_loss``, for a function made here."""
        known = {id(entry.form.node) for entry in self.handed.by_holder.get(function, ())}
        known |= {id(value) for form in self.forms.of(function) for value in self._named(function, form)}
        for definition in [each for found in function.flow.definitions.values() for each in found]:
            value = definition.value
            if definition.kind != "assign" or id(value) in known or not isinstance(value, (cst.Name, cst.Attribute)):
                continue
            if is_l1_function(self.program, function, value) and not self._is_called(function, definition.place):
                module, line = function.module, function.place(value).line
                why = f"nothing shows where {definition.place} is called"
                advice = f"legs_loss.l1_loss(rendering, photograph, own={one_line(value)}), where it is called"
                self.doubtful.append(Problem(module.path, line, module.lines.text(line), why, advice))

    def _is_called(self, function: Function, place: str) -> bool:
        """Whether ``self.loss`` is called by another method of its class."""
        owner = self.program.owner_of(function)
        methods = owner.methods.values() if owner is not None and place.startswith("self.") else ()
        return any(dotted(call.func) == place for method in methods for call in method.flow.calls)

    @staticmethod
    def _named(function: Function, form: Form) -> List[Optional[cst.CSTNode]]:
        """What the function that a form calls was given its name as."""
        return [d.value for d in function.flow.reaching(form.callee)] if form.callee is not None else []

    def _is_doubtful(self, function: Function, form: Form, left: Left) -> bool:
        """Whether a person should have a look at what was left, if nothing else is found."""
        of_class = function.owner is not None and "loss" in words(function.name)
        in_module = left.reason == "definition" and (function.name in _FORWARD or of_class)
        by_callers = left.reason == "evaluation" and "loss" in words(function.name)  # some of whose names say so
        known = left.reason in ("untrained", "unknown", "distillation", "other", "huber")
        known = known or (left.reason == "synthetic" and not _says_warped(form))  # of some callers, perhaps
        if not (in_module or by_callers or known):
            return False
        if is_measured(function, form) or self.reasons.evaluates(function):
            return False
        if left.reason == "distillation" and (detaches(form.first) or detaches(form.second)):
            return False
        pair = pair_of(self.meanings, function, form)
        pictures = "image" in (pair.a.kind, pair.b.kind)
        pictures = pictures or (function.name in _FORWARD and is_role(form.first) and is_role(form.second))
        roles = "target" in (pair.a.role, pair.b.role) or left.reason in ("distillation", "huber")
        return pictures and roles and not same_root(form) and not is_asked(function, form)

    def _doubt(self, function: Function, form: Form, place: Place, reason: str) -> Problem:
        pair = pair_of(self.meanings, function, form)
        flipped = bool(swapped(pair.a, pair.b))
        if not is_huber(self.training, function, form):
            return self._problem(function, form, place, f"nothing shows that this is the loss ({reason})", flipped)
        why = "this is a Huber loss: a weight in it would move its threshold"
        target = one_line(form.first if flipped else form.second)
        advice = f"legs_loss.weight_map({target}) times the loss, before its mean"
        return self._problem(function, form, place, why)._replace(advice=advice)

    def _is_kernel(self, function: Function, call: cst.Call) -> bool:
        """``fused_l1_ssim_loss(image, gt)``: L1 and SSIM in one, and not in this checkout."""
        name = call_name(call).lower()
        if "l1" not in name or "ssim" not in name or len(call.args) < 2 or not self.training.includes(call):
            return False
        return all(reference.kind == "external" for reference in self.program.resolve(function, call.func))

    def _of_kernel(self, function: Function, call: cst.Call, place: Place) -> Problem:
        module = function.module
        sides = ", ".join(one_line(arg.value) for arg in call.args[:2])
        advice = f"(1 - w) * legs_loss.l1_loss({sides}) + w * legs_loss.d_ssim({sides})"
        why = "L1 and SSIM are one function here; with w, its weight of SSIM, they are two"
        return Problem(module.path, place.line, module.lines.text(place.line), why, advice)

    def _of_any(self, function: Function, form: Form, place: Place) -> Left | Problem:
        pair = pair_of(self.meanings, function, form)
        reason = self.reasons.why(function, form, pair)
        if reason is not None:
            return self._left(function, place, reason)
        assert form.callee is not None
        why = f"{one_line(form.callee)} is settled at run time, and may be no L1"
        return self._problem(function, form, place, why, bool(swapped(pair.a, pair.b)))

    def _is_noise(self, function: Function, form: Form, left: Left) -> bool:
        """An absolute difference that is no loss: of angles, sizes, neighbouring pixels."""
        if form.callee is not None or form.reduction not in ("none", "wrapped", "signed"):
            return False
        trained = self.training.includes(form.node) and left.reason in _PICTURES and not same_root(form)
        if trained or left.reason in ("definition", "tracking", "distillation", "huber"):
            return False
        # Of a rendering and a photograph it is said all the same, where it may be that the trail was lost.
        return left.reason != "untrained" or not self._compares_pictures(function, form)

    def _compares_pictures(self, function: Function, form: Form) -> bool:
        pair = pair_of(self.meanings, function, form)
        pictures = pair.a.kind == pair.b.kind == "image" and {pair.a.role, pair.b.role} == {"render", "target"}
        return pictures and not is_measured(function, form) and not is_asked(function, form)

    def _is_chosen(self, function: Function, place: Place) -> bool:
        path = function.module.path
        return any(path == chosen and place.line <= line <= place.last_line for chosen, line in self.by_hand)

    @staticmethod
    def _left(function: Function, place: Place, reason: str) -> Left:
        return Left(function.module.path, place.line, function.module.lines.text(place.line), reason)

    @staticmethod
    def _callable(function: Function, form: Form, place: Place) -> Site:
        view = View(None, "a callable has no view")
        where = (function.module.path, place.line, place.column, place.line)
        return Site(*where, form, False, "", False, view, function)

    def _why_not_handed(self, holder: Function, entry: HandedOver) -> Optional[str]:
        pair = pair_of(self.meanings, entry.caller, entry.form)
        reason = self.reasons.why(entry.caller, entry.form, pair)
        if reason is None and entry.outer is not None:
            given = [self.meanings.of(holder, value) for value in arguments(entry.outer)[0][:2]]
            reason = self.reasons.use(holder, entry.outer, given) if given else "unknown"
        return "unknown" if reason is None and swapped(pair.a, pair.b) is not False else reason

    def _patched(self, function: Function) -> List[Left]:
        """What refers to legs_loss already: calls, and names that it is given."""
        if "legs_loss" not in function.module.text:
            return []
        nodes: List[cst.CSTNode] = [call.func for call in function.flow.calls]
        for definitions in function.flow.definitions.values():
            nodes.extend(d.value for d in definitions if d.kind == "assign" and isinstance(d.value, cst.Attribute))
        return [
            self._left(function, function.place(node), "patched")
            for node in nodes
            if any(r.kind == "external" and r.target in _PATCHED for r in self.program.resolve(function, node))
        ]

    # -- one form

    def _verdict(self, function: Function, form: Form, place: Place, by_hand: bool) -> Site | Left | Problem:
        pair = pair_of(self.meanings, function, form)
        if not by_hand:
            reason = "definition" if self._is_definition(function, form) else self.reasons.why(function, form, pair)
            if reason is not None:
                return self._left(function, place, reason)
        target_first = swapped(pair.a, pair.b)
        if target_first is None and not by_hand:
            if not pair.speaks_of_images:
                return self._left(function, place, "unknown")
            sides = f"{one_line(pair.first)} and {one_line(pair.second)}"
            why = f"cannot tell which of {sides} is the rendering and which the photograph"
            return self._problem(function, form, place, why)
        flipped = bool(target_first)
        picked = None if pair.selection else self._picked(function, form)
        if picked is not None:
            form = _of_whole_pictures(form, *picked)
            pair = pair._replace(first=form.first, second=form.second)
        prediction, target = (pair.second, pair.first) if flipped else (pair.first, pair.second)
        if is_rows(self.meanings, function, pair.first) or is_rows(self.meanings, function, pair.second):
            why = "the images are lists of pixels there, of which there is no weight map"
            return self._problem(function, form, place, why, flipped)
        if is_huber(self.training, function, form):
            return self._left(function, place, "huber")
        if form.reduction == "signed":
            why = (
                f"the difference {one_line(_difference(form))} was weighted where it was made, which l1_loss would lose"
            )
            return self._problem(function, form, place, why, flipped)
        if form.reduction == "taken":
            assert form.callee is not None
            why = f"{one_line(form.callee)} takes the absolute value of the difference"
            return self._problem(function, form, place, why, flipped)
        if not form.direct and not unchanged_at(function, form.call, form.first, form.second):
            return self._problem(function, form, place, "the difference has a name of its own", flipped)
        uses = self.uses.of(function, prediction, target)
        others = [(use, use.purpose) for use in uses if use.purpose is not None]
        if others and len(others) == len(uses):
            return self._left(function, place, others[0][1])
        unsettled = self.uses.unsettled(function, uses) if others else None
        if unsettled is not None:  # its body cannot be both
            first, purpose = others[0]
            why = f"{function.name} also serves {purpose} at {first.where}"
            why += f"; what it serves at {unsettled} cannot be told" if unsettled != first.where else ""
            problem = self._problem(function, form, place, why, flipped)
            return problem._replace(advice=problem.advice + _in_a_copy(function, uses))
        shared = shared_of(self.training, function, form)
        aside: Tuple[cst.Name, ...] = ()
        if shared is not None and not shared.trains:
            return self._left(function, place, "weighting" if self.training.touches(function) else "untrained")
        if shared is not None and shared.loss:
            form = form._replace(node=shared.loss[0], reduction="again")
            place = function.place(form.node)
        elif shared is not None and shared.aside:
            aside = tuple(shared.aside)
        elif shared is not None:
            return self._problem(function, form, place, f"{one_line(form.node)} serves more than the loss", flipped)
        last = self._is_channels_last(function, prediction, target, form.node)
        last = last or (picked is not None and lies_last(function, picked[0]))
        view = self.views.of(function, target, form.call)
        stands = (function.module.path, place.line, place.column, place.last_line)
        kept = tuple(self._kept(function, *other) for other in others)
        return Site(*stands, form, flipped, pair.selection + form.selection, last, view, function, aside, kept)

    @staticmethod
    def _kept(function: Function, use: Use, purpose: str) -> Kept:
        module, line = use.caller.module, use.caller.place(use.call).line
        return Kept(module.path, line, module.lines.text(line), purpose, _called(function), use.call, use.caller)

    def _picked(self, function: Function, form: Form) -> Optional[Tuple[cst.Subscript, cst.Subscript]]:
        """``image[:, mask]`` and ``photo[:, mask]`` of a form that compares names of theirs.

        None where the names stand for anything else, or where image, photo or mask is another by then.
        """
        of_torch = form.callee is not None and _is_torch(form.callee) and not form.extras
        if not form.direct or not (form.reduction in ("mean", "none") or (form.reduction == "own" and of_torch)):
            return None
        one, other = (picked_from(self.meanings, function, side) for side in (form.first, form.second))
        if one is None or other is None or not unchanged_at(function, form.call, one, other):
            return None
        alike = re.sub(r"\s+", "", _index(one)) == re.sub(r"\s+", "", _index(other))
        return (one, other) if alike else None

    def _is_channels_last(
        self, function: Function, prediction: cst.CSTNode, target: cst.CSTNode, error: cst.CSTNode
    ) -> bool:
        """Whether the two lie so; or a photograph does that the same rendering is compared with elsewhere."""
        others = [
            form.second
            for form in self.forms.of(function)
            if form.first is not prediction
            and same(form.first, prediction)
            and _is_same_place(function, form.first, prediction)
        ]
        lie = (is_channels_last(self.training, function, prediction, other, error=error) for other in (target, *others))
        return any(lie)

    def _is_definition(self, function: Function, form: Form) -> bool:
        """Whether this is the body of the codebase's own L1 function, whose calls are what counts."""
        if own_shape(self.program, function) is None:
            return False
        calls = self.training.sites.get(function) or list(sure_calls(self.program, function))
        known = {id(f.call) for caller, _ in calls for f in self.forms.of(caller)}
        return function in self.handed.functions or all(
            id(call) in known or own_shape(self.program, caller) is not None for caller, call in calls
        )

    def _problem(self, function: Function, form: Form, place: Place, reason: str, flipped: bool = False) -> Problem:
        module = function.module
        last = is_channels_last(self.training, function, form.first, form.second)
        rows = any(is_rows(self.meanings, function, side) for side in (form.first, form.second))
        advice = _advice(form, flipped, last, rows)
        return Problem(module.path, place.line, module.lines.text(place.line), reason, advice)


def _of_whole_pictures(form: Form, one: cst.Subscript, other: cst.Subscript) -> Form:
    """The same of image and photo, its result indexed by the mask."""
    form = form._replace(first=one.value, second=other.value, direct=False, selection=_index(one))
    return form._replace(reduction="mean") if form.reduction == "own" else form


def _index(node: cst.Subscript) -> str:
    return code(node)[len(code(node.value)) :].strip()


def _is_same_place(function: Function, first: cst.CSTNode, second: cst.CSTNode) -> bool:
    """Whether two expressions that are written alike are of the same values."""
    names = [[part for part in walk_expressions(node) if isinstance(part, cst.Name)] for node in (first, second)]
    return all(function.flow.reaching(one) == function.flow.reaching(other) for one, other in zip(*names))


def _advice(form: Form, flipped: bool, last: bool, rows: bool) -> str:
    """What to write by hand: the pictures themselves, where the form has lists of their pixels."""
    prediction, target = (form.second, form.first) if flipped else (form.first, form.second)
    whole, other = without_rows(prediction), without_rows(target)
    if whole is not prediction and other is not target:
        image, photo = one_line(whole), one_line(other)
        return f"legs_loss.l1_loss({image}, {photo}.reshape({image}.shape), channels_last=True)"
    if form.reduction == "signed":
        mean = ".mean()" if form.node is not form.call else ""
        weight = f"legs_loss.weight_map({one_line(target)}{', channels_last=True' if last else ''})"
        return f"torch.abs({weight} * {one_line(_difference(form))}){mean}"
    if form.reduction == "taken":
        weight = f"legs_loss.weight_map({one_line(target)}{', channels_last=True' if last else ''})"
        return one_line(_with_weight(form, weight))
    if rows:
        return "legs_loss.l1_loss(rendering, photograph), with the pictures before they became lists"
    settings = ", channels_last=True" if last else ""
    settings += ', reduction="none"' if form.reduction == "none" else ""
    if form.callee is not None and form.reduction == "own" and not form.extras and not _is_torch(form.callee):
        settings += (
            f", own={one_line(form.callee)}" if not flipped else f", own=lambda a, b: {one_line(form.callee)}(b, a)"
        )
    if form.callee is not None and form.extras:
        first, second = ("b", "a") if flipped else ("a", "b")
        extras = ", ".join(one_line(extra.with_changes(comma=cst.MaybeSentinel.DEFAULT)) for extra in form.extras)
        settings += f", own=lambda a, b: {one_line(form.callee)}({first}, {second}, {extras})"
    return f"legs_loss.l1_loss({one_line(prediction)}, {one_line(target)}{settings})"


def _with_weight(form: Form, weight: str) -> cst.Call:
    """``robust(weight * residual, config)``."""
    first = form.call.args[0]
    product = cst.parse_expression(f"{weight} * {one_line(first.value)}")
    return form.call.with_changes(args=(first.with_changes(value=product), *form.call.args[1:]))


def _difference(form: Form) -> cst.BaseExpression:
    """What the absolute value is taken of."""
    difference = abs_argument(form.call)
    assert difference is not None
    return difference


def _says_warped(form: Form) -> bool:
    """Whether a side itself speaks of a picture that is no photograph."""
    parts = [*walk_expressions(form.first), *walk_expressions(form.second)]
    said = [part.value for part in parts if isinstance(part, (cst.Name, cst.SimpleString))]
    return any(kind_of_words(text) == "warp" for text in said)


def _called(function: Function) -> str:
    """What a function is called by: of a ``forward`` the name of its class."""
    return function.owner.name if function.owner is not None and function.name in _FORWARD else function.name


def _in_a_copy(function: Function, uses: Sequence[Use]) -> str:
    """Where to write it, for a function that some calls need as it is."""
    calls = [use.where for use in uses if use.purpose is None]
    shown = ", ".join(calls[:3]) + (f" and {len(calls) - 3} more" if len(calls) > 3 else "")
    return f", in a copy of {_called(function)} for {shown}" if calls else ""


def _is_torch(callee: cst.BaseExpression) -> bool:
    """``F.l1_loss``, whose mean needs no ``own=``."""
    return re.search(r"(^|\.)(F|functional)\.l1_loss$", code(callee)) is not None
