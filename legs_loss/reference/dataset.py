"""The views of a scene as the trainer takes them: photographs and weight maps in memory, every 8th view held out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import List, Mapping, NamedTuple, Optional, Tuple

import numpy as np
import torch
from torch import Tensor

from legs_loss.errors import LegsError
from legs_loss.scenes import Camera, Scene, View, image_tensor, load_training_image
from legs_loss.spec import WeightSpec
from legs_loss.store import WeightStore, fingerprint
from legs_loss.weights import weight_from_response, weight_map

__all__ = ["Dataset", "TrainingView", "extent", "load_dataset", "split_views"]

HOLD_OUT = 8  # every so manieth view, sorted by name, as in the field
STORE = "legs_weights"


@dataclass(frozen=True, eq=False)
class TrainingView:
    """A photograph float32 [3, H, W] in [0, 1], its camera at that size, and its weight map [1, H, W] if it has one."""

    name: str
    camera: Camera
    image: Tensor
    weight: Optional[Tensor] = None


class Dataset(NamedTuple):
    """The views to train on and those held out; held-out views have no weight."""

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
    weights: Optional[Mapping[str, Tensor]] = None,
) -> Dataset:
    """Load every view of a scene.

    Args:
        scene: with cameras.
        spec: of the weight maps; with beta 0 there are none.
        resolution: 3DGS's ``-r``.
        white_background: what alpha is laid on, where the loader does so.
        store: a store of weight maps; default: ``legs_weights`` in the scene folder, if it is there. A map is taken
            from it only for the very image it was made from, else it is computed.
        weights: explicit maps [1, H, W] by view name, in place of the spec's: for experiments.

    Raises:
        LegsError: a view has no pinhole camera, a photograph cannot be read, or an explicit map is missing or does
            not fit.
    """
    train, test = split_views(scene)
    opened = _open_store(scene, store) if spec.beta > 0 and weights is None else None

    def load(view: View, weighted: bool) -> TrainingView:
        camera = _camera(scene, view)
        pixels = load_training_image(view, resolution, white_background)
        image = image_tensor(pixels)
        image = image.expand(3, *image.shape[1:]).contiguous()
        weight = None
        if weighted and weights is not None:
            weight = _explicit(weights, view, image)
        elif weighted and spec.beta > 0:
            weight = _weight(opened, view, pixels, spec)
        height, width = image.shape[1:]
        return TrainingView(view.name, camera.resized(width, height), image, weight)

    return Dataset([load(view, True) for view in train], [load(view, False) for view in test])


def extent(views: List[TrainingView]) -> float:
    """Return 3DGS's cameras_extent: 1.1 times the largest distance of a camera from the mean of all, 1 if that is 0."""
    poses = [view.camera.world_to_camera for view in views]
    centres = np.stack([-pose[:3, :3].T @ pose[:3, 3] for pose in poses])
    radius = np.linalg.norm(centres - centres.mean(0), axis=1).max()
    return 1.1 * float(radius) or 1.0


def _camera(scene: Scene, view: View) -> Camera:
    if view.camera is not None:
        return view.camera
    if view.camera_model:
        raise LegsError(
            f"{scene.root}: the camera of {view.name} is of the model {view.camera_model}: training needs PINHOLE or "
            "SIMPLE_PINHOLE: undistort the photographs first (colmap image_undistorter, or 3DGS's convert.py)"
        )
    raise LegsError(f"{scene.root}: {view.name} has no camera: training needs a scene with poses (COLMAP's sparse/0)")


def _open_store(scene: Scene, store: Optional[Path]) -> Optional[WeightStore]:
    if store is not None:
        return WeightStore(store)
    default = scene.root / STORE
    return WeightStore(default) if (default / "manifest.json").is_file() else None


def _weight(store: Optional[WeightStore], view: View, pixels: np.ndarray, spec: WeightSpec) -> Tensor:
    entry = None if store is None else store.find(view.name, pixels.shape[0], pixels.shape[1], spec)
    if store is not None and entry is not None and entry.fingerprint == fingerprint(pixels):
        return weight_from_response(torch.from_numpy(store.normalised_response(entry))[None], spec)
    return weight_map(image_tensor(pixels), spec)


def _explicit(weights: Mapping[str, Tensor], view: View, image: Tensor) -> Tensor:
    if view.name not in weights:
        raise LegsError(f"no weight map was given for the view {view.name}")
    weight = torch.as_tensor(weights[view.name], dtype=torch.float32)
    if tuple(weight.shape) != (1,) + tuple(image.shape[1:]):
        raise LegsError(
            f"the weight map given for {view.name} has the shape {list(weight.shape)}; "
            f"its photograph needs {[1, *image.shape[1:]]}"
        )
    return weight
