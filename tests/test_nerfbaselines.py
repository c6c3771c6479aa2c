"""The NerfBaselines method: listed by NerfBaselines itself, and its own parts on stand-ins for the classes below it."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
import textwrap
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from tests.support import ROOT

EXAMPLE = ROOT / "examples" / "nerfbaselines"
FAKE = {
    "nerfbaselines/__init__.py": "specs = []\nregister = specs.append",
    "nerfbaselines/methods/__init__.py": "",
    "nerfbaselines/utils.py": """
        import numpy as np

        def convert_image_dtype(image, dtype):
            if image.dtype == dtype:
                return image
            if dtype == np.uint8:
                return (image * 255).round().astype(np.uint8)
            return image.astype(dtype) / (255 if image.dtype == np.uint8 else 1)
        """,
    "nerfbaselines/methods/nerfstudio.py": """
        class _CustomDataParser:
            def __init__(self, dataset, transform, scale, config):
                self.dataset, self.given = dataset, (transform, scale, config)

            def get_dataparser_outputs(self):
                return self.cameras and self

            @property
            def cameras(self):
                return self.dataset["cameras"], self.given

        class NerfStudio:
            def __init__(self, *, checkpoint, train_dataset, config_overrides):
                self.given = config_overrides

            @classmethod
            def get_method_info(cls):
                features = ("points3D_xyz",) if cls._require_points3D else ()
                return {"method_id": "", "required_features": features, "supported_camera_models": ("opencv",)}

            def _patch_dataparser(self, dataparser_cls, *, train_dataset, dataparser_transforms):
                return train_dataset

            def _patch_config(self, config, *, train_dataset):
                return config

            def _format_output(self, output, options):
                return {name: value.numpy() for name, value in output.items()}
        """,
}


@pytest.fixture
def method(tmp_path, monkeypatch):
    """The method's class, its base a stand-in."""
    pytest.importorskip("yaml")  # nerfstudio brings it
    for path, text in FAKE.items():
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(textwrap.dedent(text))
    monkeypatch.syspath_prepend(str(EXAMPLE))
    monkeypatch.syspath_prepend(str(tmp_path))
    before = {name: module for name, module in sys.modules.items() if name.split(".")[0] == "nerfbaselines"}
    for name in before:
        monkeypatch.delitem(sys.modules, name)
    yield importlib.import_module("splatfacto_legs").SplatfactoLegs
    for name in [name for name in sys.modules if name.split(".")[0] == "nerfbaselines"]:
        del sys.modules[name]
    sys.modules.pop("splatfacto_legs", None)


class Photographs:
    """As nerfstudio's InputDataset, read from files: nothing of it may be asked for."""

    def get_numpy_image(self, image_idx):
        raise AssertionError("a file was read")


class FullImages:
    """As nerfstudio's FullImageDatamanager."""

    dataset_type = Photographs
    cameras = [2, 0, 1]

    def sample_train_cameras(self):
        return list(self.cameras)


def test_photographs_and_masks_are_those_of_nerfbaselines(method):
    images = [np.full((4, 6, 3), 0.5, np.float32), np.arange(72, dtype=np.uint8).reshape(4, 6, 3)]
    dataset = {"images": images, "masks": [np.zeros((4, 6), bool), np.full((4, 6), 255, np.uint8)]}
    model = method()
    manager = model._patch_datamanager(FullImages, train_dataset=dataset, config=None)()
    read = manager.dataset_type()
    dataset["images"] = None  # NerfBaselines frees its reference once the method is set up
    assert read.get_numpy_image(0).dtype == np.uint8
    assert read.get_numpy_image(0)[0, 0].tolist() == [128] * 3
    assert np.array_equal(read.get_numpy_image(1), images[1])
    for index, value in enumerate((0.0, 1.0)):
        mask = read.get_metadata({"image_idx": index})["mask"]
        assert mask.shape == (4, 6, 1) and mask.dtype == torch.float32
        assert mask.unique().tolist() == [value]
    assert model._patch_dataparser(None, train_dataset=dataset, dataparser_transforms=None)["masks"] is None
    assert dataset["masks"] is not None


def test_a_checkpoint_opens_without_photographs(method):
    manager = method()._patch_datamanager(FullImages, train_dataset=None, config=None)()
    assert manager.dataset_type is Photographs
    assert manager.sample_train_cameras() == [2, 0, 1]
    manager.cameras = []
    assert manager.sample_train_cameras() == [0]  # nerfstudio refuses an empty list
    assert len(manager.create_eval_dataset()) == 0


def test_a_camera_is_rendered_whole(method):
    asked = []

    def draw(cameras):
        asked.append(cameras)
        return {"rgb": torch.ones(4, 6, 3), "accumulation": torch.ones(4, 6, 1), "depth": torch.ones(4, 6, 1)}

    trained = SimpleNamespace(dataparser_transform="transform", dataparser_scale=2.0)
    pipeline = SimpleNamespace(
        eval=lambda: None,
        datamanager=SimpleNamespace(train_dataparser_outputs=trained),
        model=SimpleNamespace(get_outputs_for_camera=draw),
    )
    model = method()
    model._trainer = SimpleNamespace(pipeline=pipeline)
    model.config = SimpleNamespace(pipeline=SimpleNamespace(datamanager=SimpleNamespace(dataparser="parser")))
    shapes = {name: value.shape for name, value in model.render(SimpleNamespace(item=lambda: np.array(7))).items()}
    assert shapes == {"color": (4, 6, 3), "accumulation": (4, 6), "depth": (4, 6)}
    [(camera, given)] = asked
    assert camera.tolist() == [7] and given == ("transform", 2.0, "parser")


def test_it_asks_for_points_and_pinholes(method):
    information = method.get_method_info()
    assert information["required_features"] == ("points3D_xyz",)
    assert information["supported_camera_models"] == {"pinhole"}
    config = SimpleNamespace(pipeline=SimpleNamespace(datamanager=SimpleNamespace()))
    assert method()._patch_config(config, train_dataset=None).pipeline.datamanager.train_num_rays_per_batch == 1
    assert method._default_nerfstudio_name == "splatfacto-legs"


def test_settings_of_the_command_line_have_types(method):
    text = {"max_num_iterations": "30", "pipeline.model.background_color": "white", "method": "splatfacto"}
    model = method(config_overrides=text)
    assert model.given == {"max_num_iterations": 30, "pipeline.model.background_color": "white"}
    assert model._default_nerfstudio_name == "splatfacto"
    assert method()._default_nerfstudio_name == "splatfacto-legs"


@pytest.mark.slow
def test_nerfbaselines_lists_it(tmp_path):
    """NerfBaselines, from the registry, in an environment of its own: it asks for a numpy of before 2.0."""
    subprocess.run([sys.executable, "-m", "venv", str(tmp_path / "venv")], check=True)
    python = tmp_path / "venv" / "bin" / "python"
    pip = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    if subprocess.run([*pip, "nerfbaselines==1.2.12"], capture_output=True).returncode:
        pytest.skip("NerfBaselines could not be installed")
    places = {"PYTHONPATH": str(EXAMPLE), "NERFBASELINES_REGISTER": str(EXAMPLE / "splatfacto_legs_spec.py")}
    environment = dict(os.environ, **places)
    program = (
        "import nerfbaselines, sys\n"
        "from nerfbaselines.backends import get_implemented_backends\n"
        "spec = nerfbaselines.get_method_spec('splatfacto-legs')\n"
        "print(spec['method_class'], get_implemented_backends(spec))\n"
        "assert 'torch' not in sys.modules\n"
    )
    found = subprocess.run([str(python), "-c", program], env=environment, capture_output=True, text=True)
    assert found.returncode == 0, found.stderr
    assert found.stdout == "splatfacto_legs:SplatfactoLegs ['python']\n"
    listed = subprocess.run(
        [str(python), "-m", "nerfbaselines", "train", "--help"], env=environment, capture_output=True, text=True
    )
    assert "splatfacto-legs" in listed.stdout, listed.stderr
