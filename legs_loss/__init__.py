"""legs-loss: the LEGS loss for 3D Gaussian Splatting.

    from legs_loss import l1_loss       # in place of the codebase's own

See README.md for the three ways in, docs/method.md for the mathematics.
"""

from legs_loss._version import __version__
from legs_loss.curves import register_curve
from legs_loss.errors import LegsError
from legs_loss.loss import LEGSLoss, legs_loss, weighted_l1
from legs_loss.response import response
from legs_loss.runtime import configure, l1_loss
from legs_loss.spec import PRESETS, WeightSpec
from legs_loss.ssim import d_ssim, ssim
from legs_loss.weights import weight_map

__all__ = [
    "PRESETS",
    "LEGSLoss",
    "LegsError",
    "WeightSpec",
    "__version__",
    "configure",
    "d_ssim",
    "l1_loss",
    "legs_loss",
    "register_curve",
    "response",
    "ssim",
    "weight_map",
    "weighted_l1",
]
