"""The ``GaussianRasterizer`` of Inria's family: inputs bound by name and checked, the reference rasterizer called."""

from __future__ import annotations

from typing import Any, Dict, NamedTuple, Optional, Tuple

import torch
from torch import Tensor, nn

from legs_adapters.shims.inria.camera import pinhole
from legs_adapters.shims.missing import MissingShim, check_finite, refuse_unknown
from legs_loss import LegsError
from legs_loss.lab.rasterizer import NEAR, CompactBox, Drawn, Lens, Tensors, draw

__all__ = ["GivenGaussians", "Rasterizer", "RasterizerBase", "check_one_of", "given_or_none"]


class GivenGaussians(NamedTuple):
    """Inputs of Inria's rasterizer: spherical harmonics or colours, scales and rotations or covariances.

    means3D [N, 3]; means2D [N, 2 to 4], which receives a gradient; opacities [N, 1]; shs [N, K, 3];
    colors_precomp [N, 3]; scales [N, 3] and rotations [N, 4], wxyz; or cov3D_precomp [N, 6], the upper triangle of each
    covariance by its rows, in world units^2, to which no scale_modifier is applied. Missing inputs may be empty.
    """

    means3D: Tensor
    means2D: Tensor
    opacities: Tensor
    shs: Any = None
    colors_precomp: Any = None
    scales: Any = None
    rotations: Any = None
    cov3D_precomp: Any = None


class RasterizerBase(nn.Module):
    """A Module with a view's settings, whose unknown attributes are a `MissingShim`.

    Attributes:
        inputs: the names of ``forward``'s arguments, in their order.
    """

    inputs: Tuple[str, ...] = GivenGaussians._fields

    def __init__(self, raster_settings: Any) -> None:
        super().__init__()
        self.raster_settings = raster_settings

    @property
    def module(self) -> str:
        """The import name of the module that this replaces."""
        return type(self).__module__.rpartition(".")[2]

    def markVisible(self, positions: Tensor) -> Tensor:
        """Return bool [N]: which of the points [N, 3] are beyond the near plane, as upstream."""
        view = self.raster_settings.viewmatrix
        with torch.no_grad():
            return positions @ view[:3, 2] + view[3, 2] > NEAR

    def bind(self, positional: Tuple[Any, ...], keywords: Dict[str, Any]) -> Dict[str, Any]:
        """Return ``forward``'s arguments by name, None for missing ones; raise for unknown ones."""
        if len(positional) > len(self.inputs):
            raise TypeError(f"{self.module}.GaussianRasterizer.forward takes {len(self.inputs)} positional arguments")
        given = dict(dict.fromkeys(self.inputs), **dict(zip(self.inputs, positional)))
        refuse_unknown(self.module, {name: value for name, value in keywords.items() if name not in given})
        given.update((name, value) for name, value in keywords.items() if name in given)
        return given

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):  # torch asks
            return super().__getattr__(name)
        raise MissingShim(self.module, f"GaussianRasterizer.{name}")


class Rasterizer(RasterizerBase):
    """Draw Gaussians from the view of its settings. A fork's differs in ``inputs``, `lens`, `clip` and `results`."""

    inputs: Tuple[str, ...] = (*GivenGaussians._fields, "dc")

    def forward(self, *args: Any, **kwargs: Any) -> Any:
        """Draw, and return `results`."""
        given = self.bind(args, kwargs)
        dc = given.pop("dc", None)  # the constant harmonic, which some forks pass separately
        if dc is not None and dc.numel():
            given["shs"] = dc if given["shs"] is None else torch.cat([dc, given["shs"]], 1)
        gaussians = GivenGaussians(**{name: given[name] for name in GivenGaussians._fields})
        return self.results(self.draw(gaussians), given)

    def lens(self) -> Lens:
        """Return how the settings change the footprints."""
        return Lens()

    def clip(self, gaussians: GivenGaussians) -> Optional[CompactBox]:
        """Return a function that restricts Gaussians to fewer tiles, or None."""
        return None

    def results(self, drawn: Drawn, given: Dict[str, Any]) -> Any:
        """Return the image [3, H, W] and the radii int32 [N], 0 for what is not drawn; a fork may return more."""
        return drawn.image, drawn.radii

    def visible_filter(
        self,
        means3D: Tensor,
        scales: Optional[Tensor] = None,
        rotations: Optional[Tensor] = None,
        cov3D_precomp: Optional[Tensor] = None,
    ) -> Tensor:
        """Return radii int32 [N], 0 for what is out of sight, before anything is drawn: Scaffold-GS and its family."""
        nothing = means3D.new_zeros(len(means3D), 3)
        with torch.no_grad():  # transparent Gaussians have a radius, and need no blending
            given = means3D, nothing, nothing[:, :1], None, nothing, scales, rotations, cov3D_precomp
            return self.draw(GivenGaussians(*given)).radii

    def draw(self, gaussians: GivenGaussians) -> Drawn:
        """Draw, differentiable in everything but the view.

        Raises:
            LegsError: both or none of two ways to give colours or shapes; values that are not finite.
            MissingShim: a camera that is not covered.
        """
        settings, given = self.raster_settings, gaussians
        shs, colours, scales, rotations, covariances = (given_or_none(tensor) for tensor in given[3:])
        check_one_of(self.module, shs, colours, scales, rotations, covariances)
        view = pinhole(settings, self.module)
        if scales is not None and settings.scale_modifier != 1:
            scales = scales * settings.scale_modifier
        viewspace = None
        if given.means2D.requires_grad:
            viewspace = given.means2D[:, : 4 if given.means2D.shape[1] == 4 else 2]
        tensors = Tensors(given.means3D, scales, rotations, given.opacities, shs, colours, viewspace, covariances)
        check_finite(self.module, tensors._asdict())
        degree = int(settings.sh_degree)
        return draw(tensors, view, settings.bg, degree, self.lens(), self.clip(gaussians))


def given_or_none(tensor: Optional[Tensor]) -> Optional[Tensor]:
    """Return None for a missing input: scripts pass None or an empty tensor."""
    return None if tensor is None or tensor.numel() == 0 else tensor


def check_one_of(module: str, shs: Any, colours: Any, scales: Any, rotations: Any, cov3D: Any) -> None:
    """Raise a LegsError unless colours and shapes are each given in exactly one way; None is missing."""
    if (shs is None) == (colours is None):
        raise LegsError(f"{module}: give either shs or colors_precomp")
    if (scales is None or rotations is None) == (cov3D is None) or (scales is None) != (rotations is None):
        raise LegsError(f"{module}: give either scales and rotations or cov3D_precomp")
