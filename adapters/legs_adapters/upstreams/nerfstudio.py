"""nerfstudio: the method ``splatfacto-legs``, which is splatfacto with its L1 weighted and nothing else changed.

After ``pip install legs-loss`` in nerfstudio's environment, ``ns-train splatfacto-legs`` is available, by the entry
point ``nerfstudio.method_configs``. nerfstudio is imported only when it requests the method: it does so while it builds
its list of methods, and this module must be importable then. ``legs_loss.apply_to_nerfstudio()`` weights
``splatfacto`` itself, for those who start it from Python.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
import importlib
from typing import Any, Dict

import legs_loss
from legs_loss.runtime import active
from legs_loss.upstreams import Applied

METHOD = "splatfacto-legs"
DESCRIPTION = "Gaussian Splatting with the LEGS loss: splatfacto, its L1 weighted towards contours and thin structures."


def __getattr__(name: str) -> Any:
    if name == "splatfacto_legs":
        return _specification()
    if name == "SplatfactoLegsModel" and name in globals():
        return globals()[name]
    if name == "SplatfactoLegsModel":  # the config.yml of a run has this name
        base = importlib.import_module("nerfstudio.models.splatfacto").SplatfactoModel
        globals()[name] = model = legs_model(base)
        return model
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def _specification() -> Any:
    """Return nerfstudio's description of the method: splatfacto's own settings, another model class."""
    from nerfstudio.configs.method_configs import method_configs
    from nerfstudio.plugins.types import MethodSpecification

    trainer = copy.deepcopy(method_configs["splatfacto"])
    trainer.method_name = METHOD
    trainer.pipeline.model = dataclasses.replace(trainer.pipeline.model, _target=__getattr__("SplatfactoLegsModel"))
    return MethodSpecification(config=trainer, description=DESCRIPTION)


def apply(applied: Applied) -> None:
    """Weight the loss of splatfacto itself, and of methods derived from it."""
    model = importlib.import_module("nerfstudio.models.splatfacto").SplatfactoModel
    own = model.get_loss_dict

    @functools.wraps(own)
    def get_loss_dict(self: Any, outputs: Any, batch: Any, metrics_dict: Any = None) -> Dict[str, Any]:
        losses = own(self, outputs, batch, metrics_dict)
        return losses if isinstance(self, _Weighted) else weighted(self, losses, outputs, batch)

    applied.replace(model, "get_loss_dict", get_loss_dict)


class _Weighted:
    """Mark the models of `splatfacto-legs`, whose loss is weighted already."""


def legs_model(base: Any) -> Any:
    """Return a subclass of splatfacto's model that differs in its loss alone."""

    class SplatfactoLegsModel(_Weighted, base):
        """Splatfacto with the LEGS loss."""

        def get_loss_dict(self, outputs: Any, batch: Any, metrics_dict: Any = None) -> Dict[str, Any]:
            """Return splatfacto's losses, the L1 share of ``main_loss`` weighted."""
            return weighted(self, super().get_loss_dict(outputs, batch, metrics_dict), outputs, batch)

    SplatfactoLegsModel.__module__, SplatfactoLegsModel.__qualname__ = __name__, "SplatfactoLegsModel"
    return SplatfactoLegsModel


def weighted(model: Any, losses: Dict[str, Any], outputs: Any, batch: Any) -> Dict[str, Any]:
    """Return splatfacto's losses with the L1 share of ``main_loss`` weighted, in training and while LEGS is on."""
    # The rendering and the photograph as splatfacto's own loss compares them.
    target = model.composite_with_background(model.get_gt_img(batch["image"]), outputs["background"])
    prediction = outputs["rgb"]
    if "mask" in batch:
        mask = model._downscale_if_required(batch["mask"]).to(model.device)
        prediction, target = prediction * mask, target * mask
    if not prediction.requires_grad or not active():
        return losses
    plain = legs_loss.weighted_l1(prediction, target, channels_last=True)
    change = legs_loss.l1_loss(prediction, target, channels_last=True) - plain
    return {**losses, "main_loss": losses["main_loss"] + (1.0 - model.config.ssim_lambda) * change}
