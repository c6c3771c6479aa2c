"""The photometric L1 terms of a checkout's training steps; and every other L1 in it, with the reason it was left.

A site is an L1 between a rendering and the ground truth whose value reaches a backward pass. Everything is decided from
the tree (see flow, training, l1, meaning); what cannot be decided is a problem that a person settles, never a guess.
"""

from __future__ import annotations

import re
from typing import Dict, Iterable, List, NamedTuple, Optional, Sequence, Set, Tuple

import libcst as cst

from legs_adapters.l1 import Form, forms, own_shape
from legs_adapters.layout import is_channels_last
from legs_adapters.meaning import Meaning, Meanings
from legs_adapters.module import Function, Module
from legs_adapters.program import Program
from legs_adapters.provenance import View, Views
from legs_adapters.repo import Source, Unreadable
from legs_adapters.steps import Steps
from legs_adapters.syntax import (
    attribute_chain,
    call_name,
    code,
    constant,
    key_of,
    same,
    walk_expressions,
    word_set,
    words,
)
from legs_adapters.training import Training
from legs_adapters.upstreams import registered
from legs_adapters.vocabulary import kind_of_words, role_of_words

__all__ = ["Findings", "Left", "Problem", "Site", "find"]

_MAY_HAVE_L1 = re.compile(r"[lL]1|\babs\s*\(")
_SPLATS = re.compile(r"splat|rasteriz|gaussians|gaussian_?(model|render|scene)|render_pkg|3dgs|surfel", re.I)
_RAYS = re.compile(r"\bmesh|rays_[od]\b|ray_?bundle|ray_?samples|RaySampler|rays_valid", re.I)
_RAY_COLOURS = re.compile(r"\brgb_(map|coarse|fine)\b|\bcomp_rgb\b")
_MASK_WORDS = {
    "mask",
    "masks",
    "valid",
    "bool",
    "fg",
    "region",
    "visible",
    "hit",
    "keep",
    "inside",
    "foreground",
    "sel",
    "robust",
    "inliers",
}
_EVALUATION = word_set(
    """
    eval evaluate evaluation test testing report reports metric metrics valid validate validation render
    visualize vis benchmark compare psnr quality
    """
)
_SCORING = word_set(
    """
    score scores scoring importance densify densification prune pruning sensitivity sample sampling error
    """
)
_NOT_TRAINING = {"render", "eval", "evaluate", "test", "validate", "validation", "inference"}
_EVALUATING = {"eval", "evaluate", "evaluation", "evaluator", "test"}
_POSE = {"tracking", "track", "tracker", "localize", "localization", "relocalize", "relocalization"}
_WHY = {
    "depth": "depth", "normal": "normals", "feature": "features", "flow": "flow", "mask": "mask", "warp": "synthetic",
    "gradient": "gradients", "parameter": "regulariser",
}  # fmt: skip


class Site(NamedTuple):
    """One photometric L1 term.

    Attributes:
        path, line, column: where it begins; the line counts from 1, the column from 0.
        last_line: where it ends.
        form: the expression.
        swapped: the ground truth is the first of the two arguments.
        selection: the index by a mask that both arguments carry, as written with its brackets; empty without.
        channels_last: the images are [H, W, C].
        view: the verdict on ``view=``.
        scope: the function that it stands in.
        aside: other reads of the same error map, which are not the loss and keep the plain one.
    """

    path: str
    line: int
    column: int
    last_line: int
    form: Form
    swapped: bool
    selection: str
    channels_last: bool
    view: View
    scope: Function
    aside: Tuple[cst.Name, ...] = ()

    @property
    def function(self) -> str:
        """The name of the function that it stands in."""
        return self.scope.name

    def named_by(self, line: int) -> bool:
        """Whether a line that a person names is one of its lines."""
        return self.line <= line <= self.last_line


class Left(NamedTuple):
    """An L1 that was seen and left, with one word why."""

    path: str
    line: int
    text: str
    reason: str


class Problem(NamedTuple):
    """A term that a person must settle: where it is, what it says, and what to write there by hand."""

    path: str
    line: int
    text: str
    reason: str
    advice: str


class Findings(NamedTuple):
    """All that was found; in the order of the files."""

    sites: List[Site]
    left: List[Left]
    problems: List[Problem]
    patched: List[Left]
    unreadable: List[Unreadable]
    program: Program


def find(sources: Iterable[Source], by_hand: Sequence[Tuple[str, int]] = ()) -> Findings:
    """Find the photometric terms of a checkout.

    Args:
        sources: its files.
        by_hand: (path, line) of L1 terms that are sites because the user says so; nothing else is a site then.
    """
    return _Finder(Program(sources), by_hand).run()


class _Shared(NamedTuple):
    """The reads of an error map: the one to be weighted in its place; and those that are to keep the plain map.

    ``trains`` is False where none of the reads is the loss.
    """

    loss: List[cst.Name]
    aside: List[cst.Name]
    trains: bool = True


class _Finder:
    def __init__(self, program: Program, by_hand: Sequence[Tuple[str, int]]) -> None:
        self.program = program
        self.by_hand = set(by_hand)
        self.training = Training(program)
        self.meanings = Meanings(program, self.training)
        self.views = Views(program)
        self.steps = Steps(program, self.training)
        self.found = Findings([], [], [], [], [], program)
        self._forms: Dict[Function, List[Form]] = {}
        self._handed: Set[Function] = set()
        self._splats: Dict[str, bool] = {}
        self._references: Dict[Function, List[Tuple[cst.BaseExpression, str, List[Tuple[Function, cst.Call]]]]] = {}

    def run(self) -> Findings:
        says = self.program.prospects.of
        modules = self.program.matching(_MAY_HAVE_L1)
        for module in modules:
            for function in module.scopes(says):
                # Elsewhere an L1 could only be one by a name of a name, and nothing trains on it.
                if self.program.prospects.near(function.text) or self.training.touches(function):
                    self._forms[function] = forms(self.program, function)
        self._hand_over()
        for module in modules:
            if (
                any(self._forms.get(function) or function in self._references for function in module.scopes(says))
                or "legs_loss" in module.text
                or registered.MENTIONED.search(module.text)
            ):
                self._module(module)
        self.found.unreadable.extend(self.program.unreadable[path] for path in sorted(self.program.unreadable))
        return self.found

    def _module(self, module: Module) -> None:
        try:
            entries, patched = self._entries(module)
        except ValueError:
            self.program.give_up(module.path, "cannot be written back exactly")
            return
        if module.failure is not None:
            return
        for _, entry in sorted(entries, key=lambda item: item[0]):
            if isinstance(entry, Site):
                self.found.sites.append(entry)
            elif isinstance(entry, Problem):
                self.found.problems.append(entry)
            else:
                self.found.left.append(entry)
        self.found.patched.extend(sorted(patched, key=lambda entry: entry.line))

    def _entries(self, module: Module) -> Tuple[List[Tuple[Tuple[int, int], Site | Left | Problem]], List[Left]]:
        """What is to be said of each L1 in a file, by where it is; and what is patched already."""
        entries: List[Tuple[Tuple[int, int], Site | Left | Problem]] = []
        patched: List[Left] = []
        by_hand = bool(self.by_hand)
        chosen = {line for path, line in self.by_hand if path == module.path}
        for function in module.scopes(self.program.prospects.of):
            for form in self._forms.get(function, []):
                start = function.place(form.node)
                where = (start.line, start.column)
                end = start.last_line
                text = module.lines.text(start.line)
                verdict = self._verdict(
                    module, function, form, where, end, text, any(start.line <= line <= end for line in chosen)
                )
                if isinstance(verdict, Site) and verdict.form.node is not form.node:
                    span = function.place(verdict.form.node)
                    verdict = verdict._replace(line=span.line, column=span.column, last_line=span.last_line)
                if by_hand and not isinstance(verdict, Left):
                    assert verdict is None or isinstance(verdict, (Site, Problem))
                    if not any(start.line <= line <= end for line in chosen):
                        verdict = Left(module.path, start.line, text, "not chosen")
                if verdict is not None and not (isinstance(verdict, Left) and _is_noise(form, verdict)):
                    entries.append((where, verdict))
            for reference in self._referenced(module, function):
                if not by_hand or reference.line in chosen:
                    entries.append(((reference.line, 0), reference))
            for node in self._patched(function) if "legs_loss" in module.text else ():
                start = function.place(node)
                patched.append(Left(module.path, start.line, module.lines.text(start.line), "patched"))
            for call in function.flow.calls if registered.MENTIONED.search(function.text) else ():
                callable_form = registered.form_of(self.program, function, call)
                if callable_form is not None:
                    start = function.place(callable_form.node)
                    where = (start.line, start.column)
                    if not by_hand or start.line in chosen:
                        view = View(None, "a registered callable has no view")
                        site = Site(module.path, *where, start.line, callable_form, False, "", False, view, function)
                        entries.append((where, site))
        return entries, patched

    def _patched(self, function: Function) -> List[cst.CSTNode]:
        """What refers to legs_loss.l1_loss already: calls, and names that it is given."""
        nodes: List[cst.CSTNode] = [call.func for call in function.flow.calls]
        for definitions in function.flow.definitions.values():
            nodes.extend(d.value for d in definitions if d.kind == "assign" and isinstance(d.value, cst.Attribute))
        return [
            node
            for node in nodes
            if any(
                r.kind == "external" and r.target == "legs_loss.l1_loss" for r in self.program.resolve(function, node)
            )
        ]

    # -- one form

    def _verdict(
        self, module: Module, function: Function, form: Form, where: Tuple[int, int], end: int, text: str, by_hand: bool
    ) -> Site | Left | Problem | None:
        line = where[0]
        first, second, index = self._indexed(function, form)
        a, b = self.meanings.of(function, first), self.meanings.of(function, second)
        if not by_hand:
            reason = self._why_left(module, function, form, a, b)
            if reason is not None:
                return Left(module.path, line, text, reason)
        swapped = self._swapped(a, b)
        if swapped is None:
            if not by_hand:
                if not (_speaks_of_images(first) and _speaks_of_images(second)):
                    return Left(module.path, line, text, "unknown")
                return self._unclear(module, line, text, form, a, b)
            swapped = False
        if not form.direct:
            return self._problem(module.path, line, text, form, swapped, "the difference has a name of its own")
        shared = self._shared(function, form)
        aside: Tuple[cst.Name, ...] = ()
        if shared is not None and not shared.trains:
            return Left(module.path, line, text, "weighting")
        if shared is not None and shared.loss:
            form = form._replace(node=shared.loss[0], reduction="again")
        elif shared is not None and shared.aside:
            aside = tuple(shared.aside)
        elif shared is not None:
            why = f"{_short(form.node)} serves more than the loss"
            return self._problem(module.path, line, text, form, swapped, why)
        prediction, target = (second, first) if swapped else (first, second)
        last = is_channels_last(self.training, function, prediction, target)
        view = self.views.of(function, target, form.call)
        return Site(module.path, *where, end, form, swapped, index, last, view, function, aside)

    def _shared(self, function: Function, form: Form) -> Optional[_Shared]:
        """``error = torch.abs(image - gt)`` that also makes a mask, say: which reads of it are the loss, which are not.

        None where it is the loss alone (and what is logged of it).
        """
        made = [
            definition
            for definitions in function.flow.definitions.values()
            for definition in definitions
            if definition.kind == "assign" and definition.value is form.node and "." not in definition.place
        ]
        if form.reduction != "none" or not made:
            return None
        reads = [read for read in function.flow.reads if made[0] in function.flow.reaching(read)]
        callers = {id(arg.value): call for call in function.flow.calls for arg in call.args}
        masks = [read for read in reads if id(read) in callers and _makes_mask(callers[id(read)])]
        loss = [read for read in reads if self.training.includes(read) and read not in masks]
        logged = {
            id(part)
            for call in function.flow.calls
            if call_name(call) in ("item", "tolist", "numpy")
            for part in attribute_chain(call)
        } | function.flow.without_grad
        aside = [read for read in reads if read not in loss and id(read) not in logged]
        if not aside:
            return None
        if not loss:
            return _Shared([], [], False)
        again = loss if len(loss) == 1 and self._unchanged(function, form.first, form.second) else []
        known = all(
            function.flow.names_at(callers[id(read)], part.value) == function.flow.reaching(part)
            for read in aside
            for image in (form.first, form.second)
            for part in walk_expressions(image)
            if id(read) in callers and isinstance(part, cst.Name) and function.flow.reaching(part)
        )
        return _Shared(again, aside if known and all(id(read) in callers for read in aside) else [])

    @staticmethod
    def _unchanged(function: Function, *images: cst.CSTNode) -> bool:
        """Whether names mean the same all through a function, once they have been read here."""
        for part in (part for image in images for part in walk_expressions(image)):
            if isinstance(part, cst.Name):
                known = function.flow.reaching(part)
                everywhere = [d for d in function.flow.definitions.get(part.value, []) if d.kind != "store"]
                if known and not set(everywhere) <= known:
                    return False
        return True

    def _indexed(self, function: Function, form: Form) -> Tuple[cst.BaseExpression, cst.BaseExpression, str]:
        """Take an index by one mask off both arguments: the weight map needs the whole image."""
        first, second = form.first, form.second
        if isinstance(first, cst.Subscript) and isinstance(second, cst.Subscript):
            inner = [code(node)[len(code(node.value)) :] for node in (first, second)]
            squeezed = [re.sub(r"\s+", "", text) for text in inner]
            if squeezed[0] == squeezed[1] and any(self._is_mask(function, element) for element in first.slice):
                return first.value, second.value, inner[0].strip()
        return first, second, ""

    def _is_mask(self, function: Function, element: cst.SubscriptElement) -> bool:
        if not isinstance(element.slice, cst.Index):
            return False
        node: cst.CSTNode = element.slice.value
        if isinstance(node, (cst.Comparison, cst.UnaryOperation)):
            return constant(node) is None
        if isinstance(node, cst.BinaryOperation):
            return isinstance(node.operator, (cst.BitAnd, cst.BitOr, cst.BitXor))
        if isinstance(node, cst.Call):
            return call_name(node) in ("bool", "squeeze", "expand", "expand_as", "repeat", "logical_not", "logical_and")
        name = node.value if isinstance(node, cst.Name) else node.attr.value if isinstance(node, cst.Attribute) else ""
        if set(words(name)) & _MASK_WORDS:
            return True
        return self.meanings.of(function, node).kind == "mask"

    def _why_left(self, module: Module, function: Function, form: Form, a: Meaning, b: Meaning) -> Optional[str]:
        if self._is_definition(function, form):
            return "definition"
        for meaning in (a, b):
            if meaning.kind in _WHY:
                return _WHY[meaning.kind]
        if constant(form.first) is not None or constant(form.second) is not None:
            return "regulariser"
        trained = self.training.includes(form.node) or self.training.includes(form.call)
        trained = trained or self._called_by_framework(function)
        if not trained or self._without_grad(function, form):
            return self._why_untrained(function, form)
        if "image" not in (a.kind, b.kind) and not _counterparts(form):
            return "unknown"
        if _same_root(form):
            return "regulariser"
        if a.role == b.role == "render":
            return "distillation"
        if _detached(form.second if self._swapped(a, b) else form.first) or any(
            _makes_mask(call) and any(arg.value is form.node for arg in call.args) for call in function.flow.calls
        ):
            return "weighting"
        owner = self.program.owner_of(function)
        names = (function.name, *function.flow.conditions.get(id(form.call), ()))
        spoken = {word for name in names for word in words(name)}
        if (spoken | set(words(owner.name if owner is not None else ""))) & _POSE:
            return "tracking"
        if len(words(function.name)) > 1 and words(function.name)[0] in _NOT_TRAINING:
            return "evaluation"
        folders, _, file = module.path.rpartition("/")
        if (words(file)[:1] and words(file)[0] in _EVALUATING) or set(folders.split("/")) & _EVALUATING:
            return "evaluation"
        if {"embedding", "embeddings"} & spoken and spoken & {"optimize", "optimise", "fit", "optim", "eval"}:
            return "evaluation"
        if not (self._about_splats(function) or self._rendered(module, function, form)) or (
            "eikonal" in module.text and _RAY_COLOURS.search(_short(form.node))
        ):
            return "other"
        return self.steps.purpose(function, form.call)

    def _is_definition(self, function: Function, form: Form) -> bool:
        """Whether this is the body of the codebase's own L1 function, whose calls are what counts."""
        if own_shape(self.program, function) is None:
            return False
        calls = self.training.sites.get(function, [])
        known = {id(f.call) for caller, _ in calls for f in self._forms_of(caller)}
        return function in self._handed or all(
            id(call) in known or own_shape(self.program, caller) is not None for caller, call in calls
        )

    def _hand_over(self) -> None:
        """Find where an L1 function is handed over by its name, ``self.criterion = l1_loss``, and called elsewhere."""
        for function, calls in list(self.training.sites.items()):
            shape = own_shape(self.program, function)
            if shape is None:
                continue
            known = {id(f.call) for caller, _ in calls for f in self._forms_of(caller)}
            unknown = [
                (caller, call)
                for caller, call in calls
                if id(call) not in known and own_shape(self.program, caller) is None and len(call.args) == 2
            ]
            if not unknown:
                continue
            for holder in self.program.mentioning(function.name):
                for definition in [d for found in holder.flow.definitions.values() for d in found]:
                    value = definition.value
                    if definition.kind != "assign" or not isinstance(value, (cst.Name, cst.Attribute)):
                        continue
                    references = self.program.resolve(holder, value)
                    if [r.target for r in references] != [function] or references[0].guess:
                        continue
                    self._handed.add(function)
                    near = [(c, call) for c, call in unknown if c.module is holder.module] or unknown
                    self._references.setdefault(holder, []).append((value, shape, near))

    def _referenced(self, module: Module, holder: Function) -> List[Site | Left]:
        found: List[Site | Left] = []
        for value, shape, calls in self._references.get(holder, []):
            caller, call = calls[0]
            first, second = call.args[0].value, call.args[1].value
            a, b = self.meanings.of(caller, first), self.meanings.of(caller, second)
            start = holder.place(value)
            form = Form(value, call, first, second, "callable" if shape == "mean" else "registered", value)
            reason = self._why_left(caller.module, caller, form, a, b)
            if reason is None and self._swapped(a, b) is not False:
                reason = "unknown"
            if reason is not None:
                found.append(Left(module.path, start.line, module.lines.text(start.line), reason))
            else:
                view = View(None, "a callable that is handed over has no view")
                found.append(
                    Site(module.path, start.line, start.column, start.line, form, False, "", False, view, holder)
                )
        return found

    def _forms_of(self, function: Function) -> List[Form]:
        if function not in self._forms:
            self._forms[function] = forms(self.program, function)
        return self._forms[function]

    def _called_by_framework(self, function: Function) -> bool:
        """Whether it makes the loss of a module's ``forward``, whose caller is settled at run time (a registry)."""
        if "loss" not in words(function.name) and "losses" not in words(function.name):
            return False
        above = [function, *self._callers(function)]
        if any(set(words(f.name)) & (_EVALUATION | _SCORING) for f in above):
            return False
        return bool(self.training.roots) and any(
            f.name == "forward" and f.owner is not None and f not in self.training.sites for f in above
        )

    def _without_grad(self, function: Function, form: Form) -> bool:
        scope: Optional[Function] = function
        if id(form.call) in function.flow.without_grad or id(form.node) in function.flow.without_grad:
            return True
        while scope is not None:
            if set(scope.decorators) & {"no_grad", "inference_mode"}:
                return True
            if scope.parent is not None and id(scope.node) in scope.parent.flow.without_grad:
                return True
            scope = scope.parent
        return False

    def _why_untrained(self, function: Function, form: Form) -> str:
        names, queue = [function], [function]
        for _ in range(2):
            queue = [caller for callee in queue for caller in self._callers(callee)]
            names.extend(queue)
        spoken = {word for f in names for word in (*words(f.name), *words(f.module.path.rsplit("/", 1)[-1]))}
        if spoken & _SCORING:
            return "scoring"
        if spoken & _EVALUATION or self._without_grad(function, form):
            return "evaluation"
        return "untrained"

    def _callers(self, function: Function) -> List[Function]:
        if not function.name or function.name.startswith("__"):
            return []
        return [
            caller
            for caller in self.program.mentioning(function.name, called=True)
            if caller is not function
            and caller.parent is not None
            and any(call_name(call) == function.name for call in caller.flow.calls)
        ][:8]

    def _about_splats(self, function: Function) -> bool:
        """Whether the file, or a file that trains through it, is about Gaussian splatting: not a network for depth."""
        seen: Set[Function] = set()
        queue = [function]
        while queue:
            current = queue.pop()
            if current in seen:
                continue
            seen.add(current)
            if self._speaks_of_splats(current.module.path):
                return True
            queue.extend(caller for caller, _ in self.training.sites.get(current, []))
        return False

    def _rendered(self, module: Module, function: Function, form: Form) -> bool:
        """Whether the rendering says so itself, or files beside it do, where the file is not about rays."""
        sides: List[cst.CSTNode] = [*walk_expressions(form.first), *walk_expressions(form.second)]
        for part in list(sides):
            if isinstance(part, cst.Name):
                for definition in function.flow.reaching(part):
                    if definition.value is not None:
                        sides.extend(walk_expressions(definition.value))
        names = {w for part in sides if isinstance(part, (cst.Name, cst.SimpleString)) for w in words(part.value)}
        if _RAYS.search(module.text):
            return False
        rendered = any(word.startswith(("render", "raster")) for word in names)
        folder = module.path.rpartition("/")[0]
        near = [path for path in self.program.sources if rendered or not folder or path.startswith(folder + "/")]
        return any(self._speaks_of_splats(path) for path in near)

    def _speaks_of_splats(self, path: str) -> bool:
        if path not in self._splats:
            self._splats[path] = _SPLATS.search(self.program.sources[path].text) is not None
        return self._splats[path]

    @staticmethod
    def _swapped(a: Meaning, b: Meaning) -> Optional[bool]:
        """Which of the two is the ground truth; None where that is not clear."""
        if b.role == "target" and a.role != "target":
            return False
        if a.role == "target" and b.role != "target":
            return True
        if a.role == "render" and b.role is None:
            return False
        if b.role == "render" and a.role is None:
            return True
        # of a composite of both and one of them, the composite is the other
        if (a.role == "render" and b.role == "both") or (a.role == "both" and b.role == "target"):
            return False
        if (a.role == "both" and b.role == "render") or (a.role == "target" and b.role == "both"):
            return True
        return None

    # -- what cannot be decided

    def _unclear(self, module: Module, line: int, text: str, form: Form, a: Meaning, b: Meaning) -> Problem:
        sides = f"{_short(form.first)} and {_short(form.second)}"
        reason = f"cannot tell which of {sides} is the rendering and which the photograph"
        return self._problem(module.path, line, text, form, False, reason)

    @staticmethod
    def _problem(path: str, line: int, text: str, form: Form, swapped: bool, reason: str) -> Problem:
        a, b = (form.second, form.first) if swapped else (form.first, form.second)
        reduction = ', reduction="none"' if form.reduction == "none" else ""
        advice = f"legs_loss.l1_loss({_short(a)}, {_short(b)}{reduction})"
        return Problem(path, line, text, reason, advice)


def _makes_mask(call: cst.Call) -> bool:
    return bool(set(words(call_name(call))) & _MASK_WORDS) or call_name(call) == "quantile"


def _speaks_of_images(node: cst.CSTNode) -> bool:
    return any(
        kind_of_words(part.value) == "image" for part in walk_expressions(node) if isinstance(part, cst.Name)
    ) or any(
        kind_of_words(str(constant(part))) == "image"
        for part in walk_expressions(node)
        if isinstance(part, cst.SimpleString)
    )


def _same_root(form: Form) -> bool:
    """``x[1:] - x[:-1]``: a picture against itself."""
    a, b = form.first, form.second
    if not (isinstance(a, cst.Subscript) and isinstance(b, cst.Subscript)) or isinstance(key_of(a), str):
        return False
    return same(a.value, b.value) and not same(a, b)


def _counterparts(form: Form) -> bool:
    """``rendered_lips`` and ``gt_lips``: the same thing, once rendered and once photographed."""
    names = []
    for node in (form.first, form.second):
        key = key_of(node)
        text = node.value if isinstance(node, cst.Name) else key if isinstance(key, str) else ""
        names.append((role_of_words(text), [w for w in words(text) if role_of_words(w) is None], words(text)))
    (a, rest_a, _), (b, rest_b, _) = names
    spoken = {word for _, _, each in names for word in each}
    rendered = any(word.startswith("render") for word in spoken)
    return {a, b} == {"render", "target"} and bool(rest_a) and rest_a == rest_b and rendered


def _detached(node: cst.CSTNode) -> bool:
    return any(isinstance(part, cst.Call) and call_name(part) in ("detach", "item") for part in attribute_chain(node))


def _is_noise(form: Form, left: Left) -> bool:
    """An absolute difference that is no loss: of angles, sizes, neighbouring pixels."""
    return (
        form.callee is None
        and form.reduction in ("none", "wrapped")
        and left.reason not in ("definition", "tracking", "distillation")
    )


def _short(node: cst.CSTNode) -> str:
    return " ".join(code(node).split())
