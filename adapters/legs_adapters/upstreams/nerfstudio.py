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
import sys
from typing import Any, Callable, Dict, Optional

import legs_loss
from legs_loss.config import find_config
from legs_loss.runtime import active
from legs_loss.spec import as_spec
from legs_loss.upstreams import Applied

METHOD = "splatfacto-legs"
DESCRIPTION = "Gaussian Splatting with the LEGS loss: splatfacto, its L1 weighted towards contours and thin structures."


# Settings as flags of ns-train, --pipeline.model.legs-beta 5; None leaves them to legs.toml and LEGS_*.
FLAGS: Dict[str, type] = {"legs_preset": str, "legs_beta": float, "legs_curve": str}


def __getattr__(name: str) -> Any:
    if name == "splatfacto_legs":
        return _specification()
    if name in ("SplatfactoLegsModel", "SplatfactoLegsModelConfig"):  # the config.yml of a run has these names
        splatfacto = importlib.import_module("nerfstudio.models.splatfacto")
        if name == "SplatfactoLegsModel":
            made = legs_model(splatfacto.SplatfactoModel)
        else:
            flags = [(flag, Optional[kind], dataclasses.field(default=None)) for flag, kind in FLAGS.items()]
            made = dataclasses.make_dataclass(name, flags, bases=(splatfacto.SplatfactoModelConfig,))
            made.__module__ = __name__
        globals()[name] = made
        return made
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def _specification() -> Any:
    """Return nerfstudio's description of the method: splatfacto's own settings, another model class."""
    from nerfstudio.configs.method_configs import method_configs
    from nerfstudio.plugins.types import MethodSpecification

    trainer = copy.deepcopy(method_configs["splatfacto"])
    trainer.method_name = METHOD
    this, model = sys.modules[__name__], trainer.pipeline.model
    values = {field.name: getattr(model, field.name) for field in dataclasses.fields(model) if field.init}
    trainer.pipeline.model = this.SplatfactoLegsModelConfig(**{**values, "_target": this.SplatfactoLegsModel})
    return MethodSpecification(config=trainer, description=DESCRIPTION)


def apply(applied: Applied) -> None:
    """Weight the loss of splatfacto itself, and of methods derived from it."""
    model = importlib.import_module("nerfstudio.models.splatfacto").SplatfactoModel
    own = model.get_loss_dict

    @functools.wraps(own)
    def get_loss_dict(self: Any, outputs: Any, batch: Any, metrics_dict: Any = None) -> Dict[str, Any]:
        if isinstance(self, _Weighted):
            return own(self, outputs, batch, metrics_dict)
        return weighted(self, functools.partial(own, self), outputs, batch, metrics_dict)

    applied.replace(model, "get_loss_dict", get_loss_dict)


class _Weighted:
    """Mark the models of `splatfacto-legs`, whose loss is weighted already."""


def legs_model(base: Any) -> Any:
    """Return a subclass of splatfacto's model that differs in its loss alone."""

    class SplatfactoLegsModel(_Weighted, base):
        """Splatfacto with the LEGS loss."""

        def __init__(self, config: Any, *arguments: Any, **named: Any) -> None:
            _configure(config)
            super().__init__(config, *arguments, **named)

        def get_loss_dict(self, outputs: Any, batch: Any, metrics_dict: Any = None) -> Dict[str, Any]:
            """Return splatfacto's losses, the L1 share of ``main_loss`` weighted."""
            return weighted(self, super().get_loss_dict, outputs, batch, metrics_dict)

    SplatfactoLegsModel.__module__, SplatfactoLegsModel.__qualname__ = __name__, "SplatfactoLegsModel"
    return SplatfactoLegsModel


def _configure(config: Any) -> None:
    """Apply the flags that ns-train was given.

    Raises:
        LegsError: a value is unknown or out of range.
    """
    given: Dict[str, Any] = {flag[len("legs_") :]: getattr(config, flag, None) for flag in FLAGS}
    given = {name: value for name, value in given.items() if value is not None}
    if given:
        preset = given.pop("preset", None)
        base = find_config().spec if preset is None else as_spec(preset)
        legs_loss.configure(dataclasses.replace(base, **given) if given else preset)


def weighted(
    model: Any, own: Callable[..., Dict[str, Any]], outputs: Any, batch: Any, metrics_dict: Any
) -> Dict[str, Any]:
    """Return splatfacto's losses with the L1 share of ``main_loss`` weighted, in training and while LEGS is on.

    Both terms are means over what a mask of a store counts.
    """
    if not outputs["rgb"].requires_grad or not active():
        return own(outputs, batch, metrics_dict)
    # The rendering and the photograph as splatfacto's own loss compares them.
    target = model.composite_with_background(model.get_gt_img(batch["image"]), outputs["background"])
    prediction: Any = outputs["rgb"]
    share: Any = 1.0
    if "mask" in batch:
        mask = model._downscale_if_required(batch["mask"]).to(model.device)
        prediction, target = prediction * mask, target * mask
    else:
        share = legs_loss.coverage(prediction, target)
        prediction = legs_loss.masked(prediction, target)
        outputs = {**outputs, "rgb": prediction}
    losses = own(outputs, batch, metrics_dict)
    main, plain = losses["main_loss"], (1.0 - model.config.ssim_lambda) * (prediction - target).abs().mean()
    photometric = (1.0 - model.config.ssim_lambda) * legs_loss.l1_loss(prediction, target, channels_last=True)
    # What is not the L1 is the structural term, a mean over all pixels.
    return {**losses, "main_loss": main + (photometric - plain) + (main - plain) * (1.0 / share - 1.0)}
