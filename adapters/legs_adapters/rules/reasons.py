"""Why an L1 is left alone, in one word: it compares no pictures, or nothing trains on it, or not the Gaussians."""

from __future__ import annotations

import re
from typing import List, Optional, Sequence

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.program import Program
from legs_adapters.code.syntax import call_name, code, constant, word_set, words
from legs_adapters.lexicon.depiction import Meanings
from legs_adapters.lexicon.masks import picked_from
from legs_adapters.lexicon.meaning import Meaning, swapped
from legs_adapters.lexicon.renderings import is_of_mesh, is_rendering
from legs_adapters.rules.no_pictures import (
    is_change,
    is_constant_tensor,
    is_given_whole,
    is_leaf,
    is_number,
    is_of_model,
    is_of_points,
    is_of_scanner,
)
from legs_adapters.rules.other_maps import is_always_the_same, is_another_map, is_under_mask
from legs_adapters.rules.purpose import Purposes
from legs_adapters.rules.splats import Splats
from legs_adapters.tensors.backward import Training
from legs_adapters.tensors.gradients import is_detached, is_without_grad
from legs_adapters.terms.error_maps import is_rescaled, takes_no_gradient
from legs_adapters.terms.form import Form
from legs_adapters.terms.forms import Forms
from legs_adapters.terms.sides import Pair, are_counterparts, of_rays, same_root
from legs_adapters.terms.ssim import is_beside_ssim

__all__ = ["Reasons"]

_BUNDLES = {"ray_bundle", "ray_samples"}
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


class Reasons:
    """Answers for one program."""

    def __init__(self, program: Program, training: Training, meanings: Meanings, forms: Forms) -> None:
        self.program = program
        self.training = training
        self.meanings = meanings
        self.forms = forms
        self.purposes = Purposes(program, training)
        self.splats = Splats(program, training)

    def why(self, function: Function, form: Form, pair: Pair) -> Optional[str]:
        """Return why a form is left; None where it is to be weighted."""
        for meaning, side, beside in ((pair.a, pair.first, pair.b), (pair.b, pair.second, pair.a)):
            pictures = meaning.kind in _LAID_OVER_PICTURES and beside.kind == "image"
            pictures = pictures and (
                is_beside_ssim(function, form.first, form.second) or is_under_mask(form, side, meaning)
            )
            if meaning.kind in _WHY and not pictures:
                return _WHY[meaning.kind]
        if constant(form.first) is not None or constant(form.second) is not None or is_of_points(form):
            return "regulariser"
        trained = self.training.includes(form.node) or self.training.includes(form.call)
        trained = trained or self._called_by_framework(function)
        if not trained or is_without_grad(function, form.call, form.node) or self._asked_without_grad(function):
            return self._why_untrained(function, form)
        if _OTHERS.search(function.module.text) and not _TORCH.search(function.module.text):
            return "not torch"
        if "image" not in (pair.a.kind, pair.b.kind) and not are_counterparts(form):
            return "unknown"
        if same_root(form) or any(is_number(self.meanings, function, side, 0) for side in (form.first, form.second)):
            return "regulariser"
        if is_constant_tensor(function, form.first) or is_constant_tensor(function, form.second):
            return "regulariser"
        if is_of_scanner(function, form):
            return "features"
        if is_change(self.meanings, function, form.first) and is_change(self.meanings, function, form.second):
            return "gradients"
        if is_leaf(function, form.first) or is_leaf(function, form.second):
            return "untrained"
        target, other = (pair.first, pair.second) if swapped(pair.a, pair.b) else (pair.second, pair.first)
        if pair.a.role == pair.b.role == "render" or self.meanings.origin(function, target).role == "render":
            return "distillation"
        if swapped(pair.a, pair.b) is not None and is_rendering(function, target):
            return "distillation"
        if is_of_model(self.program, function, target):
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
        return elsewhere or self.purposes.purpose(function, form.call)

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
        return "tracking" if self._moves_poses(caller, call) else self.purposes.purpose(caller, call)

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
        if shows and not self._is_of_training_step(function) and not self.purposes.trains_its_own(function):
            return "evaluation"
        folders, _, file = module.path.rpartition("/")
        evaluates = (words(file)[:1] and words(file)[0] in _EVALUATING) or set(folders.split("/")) & _EVALUATING
        if evaluates and not self.purposes.trains_its_own(function):
            return "evaluation"
        if set(words(function.name)) & _WARPED:
            return "synthetic"
        called = {word for name in (function.name, self._class_of(function), file) for word in words(name)}
        if called & _NETWORKS and not (is_given_whole(function, form.first) and is_given_whole(function, form.second)):
            return "features"
        if {"embedding", "embeddings"} & spoken and spoken & {"optimize", "optimise", "fit", "optim", "eval"}:
            return "evaluation"
        about = self.splats.about(function, form)
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

    def _asked_without_grad(self, function: Function) -> bool:
        """Whether no caller keeps a gradient of it: an error map for the next step's mask."""
        sites = self.training.sites.get(function, [])
        return bool(sites) and all(is_without_grad(caller, call) for caller, call in sites)

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
        if spoken & _EVALUATION or is_without_grad(function, form.call, form.node):
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
