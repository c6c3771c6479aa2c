"""Why an L1 is left alone, in one word: it compares no pictures, or nothing trains on it, or not the Gaussians."""

from __future__ import annotations

import re
from typing import Dict, List, Optional, Sequence, Set

import libcst as cst

from legs_adapters.reading.beside import is_always_the_same, is_another_map, is_beside_ssim, is_under_mask
from legs_adapters.reading.l1 import Form, Forms
from legs_adapters.reading.makers import is_of_mesh, is_rendering
from legs_adapters.reading.meaning import Meaning, Meanings
from legs_adapters.reading.module import Function, Module
from legs_adapters.reading.pair import Pair, are_counterparts, is_detached, of_rays, same_root, swapped
from legs_adapters.reading.picked import picked_from
from legs_adapters.reading.program import Program
from legs_adapters.reading.shared import is_rescaled, takes_no_gradient
from legs_adapters.reading.steps import Steps
from legs_adapters.reading.syntax import (
    JOINS,
    arguments,
    attribute_chain,
    call_name,
    code,
    constant,
    dotted,
    walk_expressions,
    word_set,
    words,
)
from legs_adapters.reading.training import Training
from legs_adapters.reading.vocabulary import kind_of_words

__all__ = ["Reasons"]

_SPLATS = re.compile(
    r"splat|rasteriz|gaussians|gaussian_?(model|render|scene)|render_gaussian|render_pkg|3dgs|surfel", re.I
)
_GAUSSIANS = re.compile(r"splat|gaussians|gaussian_?(model|render|scene|raster)|diff_\w*raster|3dgs|surfel", re.I)
_RAYS = re.compile(r"rays_[od]\b|ray_?bundle|ray_?samples|RaySampler|rays_valid", re.I)
_BUNDLES = {"ray_bundle", "ray_samples"}
_FIELD = re.compile(r"(octree|voxel|volume|volumetric|nerf)_?(render|raster)|radiance_?field", re.I)
_RAY_COLOURS = re.compile(r"\brgb_(map|coarse|fine)\b|\bcomp_rgb\b")
_TORCH = re.compile(r"^[ \t]*(import|from)[ \t]+torch", re.M)
_OTHERS = re.compile(
    r"^[ \t]*(import|from)[ \t]+(drjit|flax|jax|jittor|megengine|mindspore|mlx|paddle|tensorflow|tinygrad)\b", re.M
)
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
_MAPPING = {"mapping", "map", "mapper"}  # a class that tracks and maps says nothing of one method
_NETWORKS = {"vgg", "vgg16", "vgg19", "perceptual", "lpips", "gram"}
_WARPED = {"reprojection", "reproject", "reprojected", "warp", "warped", "warping"}
_WHY = {
    "depth": "depth", "normal": "normals", "feature": "features", "flow": "flow", "mask": "mask", "warp": "synthetic",
    "gradient": "gradients", "parameter": "regulariser",
}  # fmt: skip

# What a picture is made with, or masked by, may stand in its name; what has a depth's name is none.
_LAID_OVER_PICTURES = {"parameter", "mask", "gradient"}
_MADE_UP = {f"torch.{name}{like}" for name in ("eye", "zeros", "ones", "full") for like in ("", "_like")}
_OF_LITERALS = {"torch.tensor", "torch.as_tensor", "torch.Tensor", "torch.FloatTensor"}
_SHAPED = {"cuda", "to", "float", "view", "reshape", "unsqueeze", "expand", "expand_as", "repeat"}
_DEPTH = 8


class Reasons:
    """Answers for one program."""

    def __init__(self, program: Program, training: Training, meanings: Meanings, forms: Forms) -> None:
        self.program = program
        self.training = training
        self.meanings = meanings
        self.forms = forms
        self.steps = Steps(program, training)
        self._splats: Dict[str, bool] = {}

    def why(self, function: Function, form: Form, pair: Pair) -> Optional[str]:
        """Return why a form is left; None where it is to be weighted."""
        for meaning, side, beside in ((pair.a, pair.first, pair.b), (pair.b, pair.second, pair.a)):
            pictures = meaning.kind in _LAID_OVER_PICTURES and beside.kind == "image"
            pictures = pictures and (
                is_beside_ssim(function, form.first, form.second) or is_under_mask(form, side, meaning)
            )
            if meaning.kind in _WHY and not pictures:
                return _WHY[meaning.kind]
        if constant(form.first) is not None or constant(form.second) is not None or _of_points(form):
            return "regulariser"
        trained = self.training.includes(form.node) or self.training.includes(form.call)
        trained = trained or self._called_by_framework(function)
        if not trained or self.without_grad(function, form.call, form.node) or self._asked_without_grad(function):
            return self._why_untrained(function, form)
        if _OTHERS.search(function.module.text) and not _TORCH.search(function.module.text):
            return "not torch"
        if "image" not in (pair.a.kind, pair.b.kind) and not are_counterparts(form):
            return "unknown"
        if same_root(form) or any(self._is_number(function, side, 0) for side in (form.first, form.second)):
            return "regulariser"
        if _is_made_up(function, form.first) or _is_made_up(function, form.second):
            return "regulariser"
        if _of_scanner(function, form):
            return "features"
        if self._is_change(function, form.first) and self._is_change(function, form.second):
            return "gradients"
        if _is_leaf(function, form.first) or _is_leaf(function, form.second):
            return "untrained"
        target, other = (pair.first, pair.second) if swapped(pair.a, pair.b) else (pair.second, pair.first)
        if pair.a.role == pair.b.role == "render" or self.meanings.origin(function, target).role == "render":
            return "distillation"
        if swapped(pair.a, pair.b) is not None and is_rendering(function, target):
            return "distillation"
        if self._of_model(function, target):
            return "regulariser"
        if is_always_the_same(self.forms, function, form, other, target):
            return "other"
        if (
            is_detached(other)
            or is_rescaled(function, form)
            or any(
                any(arg.value is form.node for arg in call.args)
                and takes_no_gradient(self.training, function, call, form.node)
                for call in function.flow.calls
            )
        ):
            return "weighting"
        elsewhere = self._elsewhere(function, form)
        if elsewhere is None and is_another_map(self.forms, function, form):
            return "features"
        return elsewhere or self.steps.purpose(function, form.call)

    def _is_number(self, function: Function, node: cst.CSTNode, depth: int) -> bool:
        """Whether a side is one number made of a picture, ``image.mean()``, or one of each channel."""
        if isinstance(node, cst.Call):
            positional, keywords, _ = arguments(node)
            base = node.func.value if isinstance(node.func, cst.Attribute) else None
            own = base is not None and not (isinstance(base, cst.Name) and base.value == "torch")
            of = base if own else positional[0] if positional else None
            if call_name(node) in ("mean", "sum", "std", "var", "median"):
                axes = [*positional[0 if own else 1 :], *(keywords[key] for key in ("dim", "axis") if key in keywords)]
                return of is not None and all(isinstance(constant(axis), tuple) for axis in axes)
            moved = call_name(node) in ("detach", "clamp", "clip", "cuda", "to", "float", "sqrt")
            return moved and of is not None and self._is_number(function, of, depth)
        if isinstance(node, cst.BinaryOperation):
            for side, other in ((node.left, node.right), (node.right, node.left)):
                if self._is_number(function, side, depth) and self.meanings.of(function, other).kind != "image":
                    return True
        if isinstance(node, cst.Name) and depth < 3:
            made = [d.value for d in function.flow.reaching(node) if d.kind == "assign" and d.value is not None]
            return bool(made) and all(self._is_number(function, value, depth + 1) for value in made)
        return False

    def _is_change(self, function: Function, node: cst.CSTNode) -> bool:
        """``image_b - image_a``: how a picture changes, from view to view or under a filter."""
        sides = (node.left, node.right) if isinstance(node, cst.BinaryOperation) else ()
        changes = isinstance(node, cst.BinaryOperation) and isinstance(node.operator, cst.Subtract)
        return changes and all(self.meanings.of(function, side).kind == "image" for side in sides)

    def _of_model(self, function: Function, target: cst.CSTNode) -> bool:
        """Whether a target is what the Gaussians themselves have: ``self.get_radiances.gather(1, index)``."""
        parts = list(attribute_chain(target))
        owner = self.program.owner_of(function)
        own = isinstance(parts[-1], cst.Name) and parts[-1].value == "self" and len(parts) > 1
        return own and owner is not None and bool({"get_xyz", "oneupSHdegree"} & set(owner.methods))

    def use(self, caller: Function, call: cst.Call, given: Sequence[Meaning]) -> Optional[str]:
        """What a call of a function that compares pictures is for, if not for the loss of a Gaussian model.

        ``given`` is what it is called with: the rendering, where that is known, then the photograph.
        """
        target = given[-1]
        for meaning in given:
            if meaning.kind in _WHY:
                return _WHY[meaning.kind]
        if target.role == "render":
            return "distillation"
        if set(words(caller.name)) & _EVALUATING and "train" not in words(caller.name):
            return "evaluation"
        return "tracking" if self._moves_poses(caller, call) else self.steps.purpose(caller, call)

    def _moves_poses(self, function: Function, call: cst.Call) -> bool:
        names = (function.name, *function.flow.conditions.get(id(call), ()), self._class_of(function))
        spoken = [set(words(name)) for name in names]
        poses_of_tests = any({"test", "pose"} <= said for said in spoken)  # if config.test_opt_pose:
        return poses_of_tests or any(said & _POSE and not said & _MAPPING for said in spoken)

    def _class_of(self, function: Function) -> str:
        owner = self.program.owner_of(function)
        return owner.name if owner is not None else ""

    def evaluates(self, function: Function) -> bool:
        """Whether its class says that it evaluates: ``TestLoss``."""
        return bool(set(words(self._class_of(function))) & _EVALUATING)

    def _elsewhere(self, function: Function, form: Form) -> Optional[str]:
        """Why it is not the loss of a Gaussian model, going by the names of what is around it."""
        module = function.module
        if self._moves_poses(function, form.call):
            return "tracking"
        names = (function.name, *function.flow.conditions.get(id(form.call), ()))
        spoken = {word for name in names for word in words(name)}
        said = words(function.name)
        shows = len(said) > 1 and said[0] in _NOT_TRAINING and not {"loss", "losses"} & set(said[1:])
        if shows and not self._is_of_training_step(function) and not self.steps.trains_its_own(function):
            return "evaluation"
        folders, _, file = module.path.rpartition("/")
        evaluates = (words(file)[:1] and words(file)[0] in _EVALUATING) or set(folders.split("/")) & _EVALUATING
        if evaluates and not self.steps.trains_its_own(function):
            return "evaluation"
        if set(words(function.name)) & _WARPED:
            return "synthetic"
        called = {word for name in (function.name, self._class_of(function), file) for word in words(name)}
        if called & _NETWORKS and not (_is_given(function, form.first) and _is_given(function, form.second)):
            return "features"
        if {"embedding", "embeddings"} & spoken and spoken & {"optimize", "optimise", "fit", "optim", "eval"}:
            return "evaluation"
        about = self._about_splats(function) or self._rendered(module, function, form)
        picked = all(picked_from(self.meanings, function, side) for side in (form.first, form.second))
        rays = (of_rays(form) and not picked) or self._casts_rays(function)
        if not about or (rays and not is_beside_ssim(function, form.first, form.second)):
            return "other"
        if any(is_of_mesh(self.program, function, side) for side in (form.first, form.second)):
            return "other"
        return "other" if "eikonal" in module.text and _RAY_COLOURS.search(code(form.node)) else None

    def _is_of_training_step(self, function: Function) -> bool:
        """Whether it returns its part of a loss to functions that say that they train: ``render_batch``."""
        callers = [caller for caller, _ in self.training.sites.get(function, [])]
        return bool(callers) and all("train" in words(caller.name) for caller in callers)

    def _casts_rays(self, function: Function) -> bool:
        """Whether it is of a model that is asked for rays, ``get_outputs(self, ray_bundle)``: they make no picture."""
        owner = self.program.owner_of(function)
        return owner is not None and any(_BUNDLES & set(method.parameters) for method in owner.methods.values())

    def _called_by_framework(self, function: Function) -> bool:
        """Whether it makes the loss of a module's ``forward``, whose caller is settled at run time (a registry)."""
        if "loss" not in words(function.name) and "losses" not in words(function.name):
            return False
        above = [function, *self._callers(function)]
        above += [caller for callee in above[1:] for caller in self._callers(callee)]
        if any(set(words(f.name)) & (_EVALUATION | _SCORING) for f in above):
            return False
        return bool(self.training.roots) and any(
            f.name == "forward" and f.owner is not None and f not in self.training.sites for f in above
        )

    def without_grad(self, function: Function, *nodes: cst.CSTNode) -> bool:
        """Whether expressions stand where no gradient is kept."""
        scope: Optional[Function] = function
        if any(id(node) in function.flow.without_grad for node in nodes):
            return True
        while scope is not None:
            if set(scope.decorators) & {"no_grad", "inference_mode"}:
                return True
            if scope.parent is not None and id(scope.node) in scope.parent.flow.without_grad:
                return True
            scope = scope.parent
        return False

    def _asked_without_grad(self, function: Function) -> bool:
        """Whether no caller keeps a gradient of it: an error map for the next step's mask."""
        sites = self.training.sites.get(function, [])
        return bool(sites) and all(self.without_grad(caller, call) for caller, call in sites)

    def _why_untrained(self, function: Function, form: Form) -> str:
        names, queue = [function], [function]
        for _ in range(2):
            queue = [caller for callee in queue for caller in self._callers(callee)]
            names.extend(queue)
        said = [self._class_of(function)]
        said += [part for f in names for part in (f.name, f.module.path.rsplit("/", 1)[-1])]
        spoken = {word for part in said for word in words(part)}
        if spoken & _SCORING:
            return "scoring"
        if spoken & _EVALUATION or self.without_grad(function, form.call, form.node):
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
            speaks = self._speaks_of_splats(current.module.path) or self._takes_splats(current.module)
            if speaks and self._runs_with(function.module, current.module):
                return True
            queue.extend(caller for caller, _ in self.training.sites.get(current, []))
        return False

    def _runs_with(self, module: Module, other: Module) -> bool:
        """Whether what a function is called by, going by names, can be: it runs with it, or is near it."""
        near = other.path.split("/")[0] == module.path.split("/")[0] or "/" not in module.path
        return near or other.path in self.program.together(module)

    def _rendered(self, module: Module, function: Function, form: Form) -> bool:
        """Whether the rendering says so itself, or files beside it do, where the file is not about rays."""
        sides = _made_of(function, form)
        names = {w for part in sides if isinstance(part, (cst.Name, cst.SimpleString)) for w in words(part.value)}
        if _RAYS.search(module.text) or "mesh" in words(module.path.rpartition("/")[2]):
            return False
        if _FIELD.search(module.text):
            return False
        rendered = any(word.startswith(("render", "raster")) for word in names)
        folder = module.path.rpartition("/")[0]
        near = [path for path in self.program.sources if not folder or path.startswith(folder + "/")]
        if rendered and folder:  # of what, if no Gaussians are near? A mesh is rasterized, too
            top = folder.split("/")[0] + "/"
            together = self.program.together(module)
            near = [path for path in self.program.sources if path.startswith(top) or path in together]
            near = [path for path in near if _GAUSSIANS.search(self.program.sources[path].text)]
        return any(self._speaks_of_splats(path) for path in near)

    def _takes_splats(self, module: Module) -> bool:
        """Whether a file imports something Gaussian, ``GazeGaussianNet``, from one that speaks of splats."""
        for node in module.top.flow.imports:
            if isinstance(node, cst.ImportFrom) and "gaussian" in code(node).lower():
                found = self.program.imported_from(module, node)
                if found is not None and self._speaks_of_splats(found.path):
                    return True
        return False

    def _speaks_of_splats(self, path: str) -> bool:
        if path not in self._splats:
            self._splats[path] = _SPLATS.search(self.program.sources[path].text) is not None
        return self._splats[path]


def _is_given(function: Function, node: cst.CSTNode) -> bool:
    """Whether it is what a parameter was given, as it was given."""
    found = function.flow.reaching(node)
    return bool(found) and all(definition.kind == "parameter" for definition in found)


def _of_points(form: Form) -> bool:
    """``model.rgb_colors[point_indexes]``: rows of points, no picture."""
    indexed = [node for node in (form.first, form.second) if isinstance(node, cst.Subscript)]
    names = [element.slice.value for node in indexed for element in node.slice if isinstance(element.slice, cst.Index)]
    return any(isinstance(name, cst.Name) and {"point", "points"} & set(words(name.value)) for name in names)


def _of_scanner(function: Function, form: Form) -> bool:
    """``scan[1:2]`` of a ``scan[2:3]`` that is called depth: a channel of what a laser sees, no photograph."""
    scans = {name for part in _made_of(function, form) for name in [_one_channel_of(part)] if name is not None}
    depths = [place for place in function.flow.definitions if scans and kind_of_words(place) == "depth"]
    values = [definition.value for place in depths for definition in function.flow.definitions[place]]
    return any(_one_channel_of(part) in scans for value in values if value for part in walk_expressions(value))


def _one_channel_of(node: cst.CSTNode) -> Optional[str]:
    """``scan`` of ``scan[1:2, ...]``."""
    if not isinstance(node, cst.Subscript) or not isinstance(node.value, cst.Name):
        return None
    first = node.slice[0].slice
    if not isinstance(first, cst.Slice):
        return None
    lower, upper = constant(first.lower), constant(first.upper)
    return node.value.value if isinstance(lower, int) and upper == lower + 1 else None


def _is_made_up(function: Function, node: cst.CSTNode, depth: int = 0) -> bool:
    """Whether a side is a tensor of constants, ``torch.eye(3)``, ``torch.tensor([0, 0, 1])[:, None]``.

    Or a name for one, or for one of several, that nothing is written to.
    """
    parts: List[Optional[cst.CSTNode]] = []
    if isinstance(node, cst.Name) and constant(node) is None:
        parts = [d.value if d.kind == "assign" else None for d in function.flow.reaching(node)]
    elif isinstance(node, cst.IfExp):
        parts = [node.body, node.orelse]
    elif isinstance(node, cst.Subscript):
        parts = [node.value]
    elif not isinstance(node, cst.Call):
        return constant(node) is not None
    elif dotted(node.func) in _OF_LITERALS:
        parts = [*arguments(node)[0][:1]]
    elif isinstance(node.func, cst.Attribute) and call_name(node) in _SHAPED:
        parts = [node.func.value]
    else:
        return dotted(node.func) in _MADE_UP
    return depth < _DEPTH and bool(parts) and all(p is not None and _is_made_up(function, p, depth + 1) for p in parts)


def _is_leaf(function: Function, node: cst.CSTNode) -> bool:
    """``image = torch.tensor(array).requires_grad_()``: whose gradient is looked at, made by no rendering.

    ``torch.cat(images).requires_grad_()`` has those of the renderings.
    """
    values = [definition.value for definition in function.flow.reaching(node) if definition.kind == "assign"]
    calls = [value for value in values if isinstance(value, cst.Call) and call_name(value) == "requires_grad_"]
    asked = [call.func.value for call in calls if isinstance(call.func, cst.Attribute)]
    return any(not (isinstance(base, cst.Call) and call_name(base) in JOINS) for base in asked)


def _made_of(function: Function, form: Form) -> List[cst.CSTNode]:
    """The parts of both sides, and of what their names were made from."""
    parts: List[cst.CSTNode] = [*walk_expressions(form.first), *walk_expressions(form.second)]
    for part in list(parts):
        if isinstance(part, cst.Name):
            for definition in function.flow.reaching(part):
                if definition.value is not None:
                    parts.extend(walk_expressions(definition.value))
    return parts
