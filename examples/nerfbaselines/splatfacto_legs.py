"""NerfBaselines: the method ``splatfacto-legs``, trained and scored by its protocol beside the other methods.

NerfBaselines wraps nerfstudio for methods that sample rays; splatfacto takes whole photographs, and renders a camera.
What differs is here; all else is its ``NerfStudio`` class. ``--set method=splatfacto`` trains splatfacto itself.
"""

from __future__ import annotations

from typing import Any, Dict

import numpy as np
import torch
import yaml
from nerfbaselines.methods.nerfstudio import NerfStudio, _CustomDataParser
from nerfbaselines.utils import convert_image_dtype

__all__ = ["SplatfactoLegs"]


class SplatfactoLegs(NerfStudio):
    """Splatfacto with the LEGS loss, as NerfBaselines asks for a method; settings come from LEGS_* variables."""

    _default_nerfstudio_name = "splatfacto-legs"
    _require_points3D = True

    def __init__(self, *, checkpoint: Any = None, train_dataset: Any = None, config_overrides: Any = None) -> None:
        # ``--set`` passes text, and nerfstudio's settings have types; ``method`` is not a setting of nerfstudio.
        settings = {
            name: yaml.safe_load(value) if isinstance(value, str) else value
            for name, value in (config_overrides or {}).items()
        }
        self._default_nerfstudio_name = settings.pop("method", self._default_nerfstudio_name)
        super().__init__(checkpoint=checkpoint, train_dataset=train_dataset, config_overrides=settings)

    @classmethod
    def get_method_info(cls) -> Any:
        """Return the method's inputs and outputs; NerfBaselines undistorts other cameras than pinhole."""
        return {
            **super().get_method_info(),
            "supported_camera_models": frozenset(("pinhole",)),
            "viewer_default_resolution": 768,
        }

    @torch.no_grad()
    def render(self, camera: Any, *, options: Any = None) -> Dict[str, np.ndarray]:
        """Return color [H, W, 3], accumulation [H, W] and depth [H, W] of one camera."""
        pipeline = self._trainer.pipeline
        pipeline.eval()
        trained = pipeline.datamanager.train_dataparser_outputs
        # The camera conventions are implemented once, where the training views are read.
        parser = _CustomDataParser(
            {"cameras": camera.item()[None], "masks": None},
            trained.dataparser_transform,
            trained.dataparser_scale,
            self.config.pipeline.datamanager.dataparser,
        )
        outputs = pipeline.model.get_outputs_for_camera(parser.get_dataparser_outputs().cameras)
        images = {"color": outputs["rgb"]}
        images.update({name: outputs[name][..., 0] for name in ("accumulation", "depth")})
        return self._format_output(images, options)

    def _patch_dataparser(self, dataparser_cls: Any, *, train_dataset: Any, **settings: Any) -> Any:
        if train_dataset is not None:  # masks are passed as arrays below, not as files
            train_dataset = {**train_dataset, "masks": None}
        return super()._patch_dataparser(dataparser_cls, train_dataset=train_dataset, **settings)

    def _patch_dataset(self, dataset_cls: Any, train_dataset: Any, config: Any) -> Any:
        photographs, masks = train_dataset["images"], train_dataset.get("masks")

        class Photographs(dataset_cls):
            def get_numpy_image(self, image_idx: int) -> np.ndarray:
                return convert_image_dtype(photographs[image_idx], np.uint8)

            def get_metadata(self, data: Any) -> Dict[str, Any]:
                if masks is None:
                    return {}
                mask = convert_image_dtype(masks[data["image_idx"]], np.float32)
                return {"mask": torch.from_numpy(mask)[..., None]}

        return Photographs

    def _patch_datamanager(self, datamanager_cls: Any, *, train_dataset: Any = None, config: Any) -> Any:
        patch = self._patch_dataset

        class FullImages(datamanager_cls):
            @property
            def dataset_type(self) -> Any:
                base = super().dataset_type
                return base if train_dataset is None else patch(base, train_dataset, config)

            def create_eval_dataset(self) -> Any:
                return ()  # NerfBaselines renders and scores the held-out views itself

            def sample_train_cameras(self) -> Any:
                return super().sample_train_cameras() or [0]  # a checkpoint is opened without photographs

        return FullImages

    def _patch_config(self, config: Any, **settings: Any) -> Any:
        config = super()._patch_config(config, **settings)
        config.pipeline.datamanager.train_num_rays_per_batch = 1  # what is reported as the batch: one photograph
        return config
