"""The views of a scene for the trainer: photographs and weight maps in memory, every 8th view held out."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Iterable, List, NamedTuple, Optional, Tuple

import numpy as np
import torch
from torch import Tensor

from legs_loss.config import STORE_FOLDER
from legs_loss.errors import LegsError
from legs_loss.precompute.photograph import levels_of
from legs_loss.scenes import Camera, Scene, View, image_size, image_tensor, load_training_image
from legs_loss.spec import Spec, WeightSpec, as_spec
from legs_loss.store import Found, WeightStore
from legs_loss.system.terminal import say
from legs_loss.weights import weight_map

HOLD_OUT = 8  # every 8th view, sorted by name, as usual for 3DGS


@dataclass(frozen=True, eq=False)
class TrainingView:
    """A photograph float32 [3, H, W] in [0, 1], and its camera at that size.

    Attributes:
        weight, mask: its weight map, and the user's mask in [0, 1], each [1, H, W]; None without.
    """

    name: str
    camera: Camera
    image: Tensor
    weight: Optional[Tensor] = None
    mask: Optional[Tensor] = None

    def hidden(self, rendering: Tensor) -> Tensor:
        """Return a rendering [3, H, W] with the photograph's pixels where the mask is 0; the rendering without one."""
        return rendering if self.mask is None else torch.where(self.mask == 0, self.image, rendering)

    @property
    def counts(self) -> Optional[Tensor]:
        """Pixels that count, bool [H, W]; None where all do."""
        return None if self.mask is None else self.mask[0] > 0


class Dataset(NamedTuple):
    """The views to train on and those held out; held-out views have a mask, and no weight."""

    train: List[TrainingView]
    test: List[TrainingView]


def split_views(scene: Scene) -> Tuple[List[View], List[View]]:
    """Return the training and the held-out views: the scene's own split if it has one, else every 8th is held out.

    Raises:
        LegsError: nothing is left to train on.
    """
    if any(view.split for view in scene.views):
        train = [view for view in scene.views if view.split == "train"]
        test = [view for view in scene.views if view.split == "test"]
    else:
        train = [view for index, view in enumerate(scene.views) if index % HOLD_OUT]
        test = list(scene.views[::HOLD_OUT])
    if not train:
        raise LegsError(
            f"{scene.root}: of its {len(scene.views)} view(s) none is left to train on "
            f"(every {HOLD_OUT}th, the first included, is held out)"
        )
    return train, test


def load_dataset(
    scene: Scene,
    spec: WeightSpec,
    resolution: int = -1,
    white_background: bool = False,
    store: Optional[Path] = None,
) -> Dataset:
    """Load every view of a scene, and say where that enlarges the photographs.

    Args:
        scene: with cameras.
        spec: of the weight maps; with beta 0 there are none.
        resolution: 3DGS's ``-r``.
        white_background: what alpha is laid on, where the loader does so.
        store: a store of weight maps; default: ``legs_weights`` in the scene folder, if it is there. A map is used
            only for exactly the image that it was made from, else it is computed. Masks and weights of the user's in
            it have to be found.

    Raises:
        LegsError: a view has no pinhole camera, a photograph cannot be read, or the store has masks or weights of the
            user's, and does not know a photograph.
    """
    views = split_views(scene)
    train, test = ([load_view(scene, view, resolution, white_background) for view in some] for some in views)
    wide, trained = image_size(views[0][0].path)[0], train[0].camera.width
    if trained > wide:
        say(f"legs-loss: warning: the photographs are {wide} wide, and -r enlarges them to {trained}", sys.stderr)
    opened = open_store(scene, store)
    if not spec.unweighted:
        train = [replace(view, weight=weight) for view, weight in zip(train, _weights(opened, train, spec))]
    if opened is None or not any(entry.is_users for entry in opened.entries.values()):
        return Dataset(train, test)
    train = [with_user_maps(view, opened, user_weights=True) for view in train]
    return Dataset(train, [with_user_maps(view, opened) for view in test])


def with_user_maps(
    view: TrainingView, store: Optional[WeightStore], user_weights: bool = False, needed: bool = True
) -> TrainingView:
    """Return a view with the user's mask, and on request its weight times the user's, as a store has them.

    Raises:
        LegsError: they are needed, and the store does not know the photograph.
    """
    found = None if store is None else _found(store, view, WeightSpec())
    if store is None or (found is None and not needed):
        return view
    if found is None:
        height, width = view.image.shape[1:]
        raise LegsError(
            f"{store.path} has masks or weights of your own, and does not know {view.name} of {width}x{height}: give "
            "legs precompute the training's -r and --images"
        )
    mask, weight = (None if one is None else torch.from_numpy(store.user_map(one))[None] for one in found[2:])
    if not user_weights or weight is None:
        return replace(view, mask=mask)
    return replace(view, mask=mask, weight=weight if view.weight is None else weight * view.weight)


def load_view(scene: Scene, view: View, resolution: int = -1, white_background: bool = False) -> TrainingView:
    """Load one view, without a weight map. Gray photographs become RGB.

    Raises:
        LegsError: it has no pinhole camera, or the photograph cannot be read.
    """
    camera = pinhole_camera(scene, view)
    image = image_tensor(load_training_image(view, resolution, white_background))
    height, width = image.shape[1:]
    return TrainingView(view.name, camera.resized(width, height), image.expand(3, height, width).contiguous())


def shuffled(views: List[TrainingView], seed: int) -> List[TrainingView]:
    """Return views with each weight map's pixels in random order, another one for each view and seed."""
    generator = torch.Generator().manual_seed(1_000_003 + seed)

    def shuffle(weight: Optional[Tensor]) -> Optional[Tensor]:
        if weight is None:
            return None
        return weight.flatten()[torch.randperm(weight.numel(), generator=generator)].reshape(weight.shape)

    return [replace(view, weight=shuffle(view.weight)) for view in views]


def extent(views: List[TrainingView]) -> float:
    """Return 3DGS's cameras_extent: 1.1 times the largest distance of a camera from the mean of all, 1 if that is 0."""
    poses = [view.camera.world_to_camera for view in views]
    centres = np.stack([-pose[:3, :3].T @ pose[:3, 3] for pose in poses])
    radius = np.linalg.norm(centres - centres.mean(0), axis=1).max()
    return 1.1 * float(radius) or 1.0


def pinhole_camera(scene: Scene, view: View) -> Camera:
    """Return a view's camera.

    Raises:
        LegsError: it has none, or one with distortion.
    """
    if view.camera is not None:
        return view.camera
    if view.camera_model:
        raise LegsError(
            f"{scene.root}: the camera of {view.name} is of the model {view.camera_model}: training needs PINHOLE or "
            "SIMPLE_PINHOLE: undistort the photographs first (colmap image_undistorter, or 3DGS's convert.py)"
        )
    if scene.kind == "folder":
        raise LegsError(
            f"{scene.root} is a folder of pictures without camera poses: training needs a scene with sparse/0 of "
            "COLMAP or transforms.json; legs scene makes one of photographs"
        )
    raise LegsError(f"{scene.root}: {view.name} has no camera: training needs a scene with poses (COLMAP's sparse/0)")


def open_store(scene: Scene, store: Optional[Path] = None) -> Optional[WeightStore]:
    """Open a store of weight maps; without one named the scene's own, None where it has none."""
    if store is not None:
        return WeightStore(store)
    default = scene.root / STORE_FOLDER
    return WeightStore(default) if (default / "manifest.json").is_file() else None


def _weights(store: Optional[WeightStore], views: List[TrainingView], spec: WeightSpec) -> List[Tensor]:
    """Return the views' weight maps, of stored responses where a store has those of these very images."""
    known = [] if store is None else [_found(store, view, spec) for view in views]
    found = [None if one is None else one.response for one in known]
    # Where a map is missing, the levels of the scene are not known.
    if store is None or (spec.over == "scene" and None in found):
        return weight_maps([view.image for view in views], spec)
    pairs = zip(views, found)
    return [weight_map(view.image, spec) if one is None else store.weight(one, spec) for view, one in pairs]


def _found(store: WeightStore, view: TrainingView, spec: WeightSpec) -> Optional[Found]:
    return store.find_image(view.image, spec) or store.find_image(view.image[:1], spec)  # a gray photograph


def weight_maps(images: Iterable[Tensor], spec: Spec = "legs") -> List[Tensor]:
    """Return the weight maps [1, H, W] of a scene's images [C, H, W], whose sizes may differ.

    Raises:
        LegsError: as :func:`weight_map`.

    Examples:
        >>> sharp = (torch.rand(3, 16, 16, generator=torch.Generator().manual_seed(0)) > 0.9).float()
        >>> from legs_loss.responses import gaussian_blur
        >>> blurred = gaussian_blur(sharp, 2.0)
        >>> [round(float(weight.mean()), 1) for weight in weight_maps([sharp, sharp, blurred], "legs-robust")]
        [1.3, 1.3, 1.0]
    """
    spec, images = as_spec(spec), list(images)
    scene = levels_of(images, spec)
    return [weight_map(image, spec, False, scene) for image in images]


def dimmed(image: Any, mask: Any) -> Any:
    """Return a photograph [3, H, W] with what its mask [H, W] leaves out at a quarter of its light; None: as it is."""
    return image if mask is None else image * (0.25 + 0.75 * mask)
