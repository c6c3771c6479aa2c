"""nerfstudio: the method ``splatfacto-legs``, which is splatfacto with its L1 weighted and nothing else changed.

After ``pip install legs-loss`` in nerfstudio's environment, ``ns-train splatfacto-legs`` is there, through the entry
point ``nerfstudio.method_configs``. Nothing of nerfstudio is imported before it asks for the method: it asks while its
own list of methods is being made, and this module must be importable then.
"""

from __future__ import annotations

import copy
import dataclasses
import importlib
from typing import Any, Dict

import legs_loss
from legs_loss.runtime import active

METHOD = "splatfacto-legs"
DESCRIPTION = "Gaussian Splatting with the LEGS loss: splatfacto, its L1 weighted towards contours and thin structures."


def __getattr__(name: str) -> Any:
    if name == "splatfacto_legs":
        return _specification()
    if name == "SplatfactoLegsModel" and name in globals():
        return globals()[name]
    if name == "SplatfactoLegsModel":  # under this name it stands in the config.yml of a run
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


def legs_model(base: Any) -> Any:
    """Return a subclass of splatfacto's model that differs in its loss alone."""

    class SplatfactoLegsModel(base):
        """Splatfacto with the LEGS loss."""

        def get_loss_dict(self, outputs: Any, batch: Any, metrics_dict: Any = None) -> Dict[str, Any]:
            """Return splatfacto's losses, the L1 share of ``main_loss`` weighted."""
            losses = super().get_loss_dict(outputs, batch, metrics_dict)
            prediction, target = self._compared(outputs, batch)
            if not prediction.requires_grad or not active():
                return losses
            plain = legs_loss.weighted_l1(prediction, target, channels_last=True)
            weighted = legs_loss.l1_loss(prediction, target, channels_last=True)
            share = 1.0 - self.config.ssim_lambda
            return {**losses, "main_loss": losses["main_loss"] + share * (weighted - plain)}

        def _compared(self, outputs: Any, batch: Any) -> Any:
            """The rendering and the photograph as splatfacto's own loss compares them."""
            target = self.composite_with_background(self.get_gt_img(batch["image"]), outputs["background"])
            prediction = outputs["rgb"]
            if "mask" in batch:
                mask = self._downscale_if_required(batch["mask"]).to(self.device)
                prediction, target = prediction * mask, target * mask
            return prediction, target

    SplatfactoLegsModel.__module__, SplatfactoLegsModel.__qualname__ = __name__, "SplatfactoLegsModel"
    return SplatfactoLegsModel
