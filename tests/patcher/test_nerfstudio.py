"""The nerfstudio plugin, on a small stand-in with the parts of nerfstudio that it talks to."""

from __future__ import annotations

import importlib
import os
import sys
import textwrap

import pytest
import torch

from legs_loss import LegsError, weight_map
from legs_loss.runtime import state
from tests.preloaded import run
from tests.support import ROOT, legs_environment

FAKE = {
    "nerfstudio/__init__.py": "",
    "nerfstudio/configs/__init__.py": "",
    "nerfstudio/plugins/__init__.py": "",
    "nerfstudio/models/__init__.py": "",
    "nerfstudio/plugins/types.py": """
        from dataclasses import dataclass
        from typing import Any

        @dataclass
        class MethodSpecification:
            config: Any
            description: str
        """,
    "nerfstudio/models/splatfacto.py": """
        from dataclasses import dataclass, field
        from typing import Type
        import torch

        @dataclass
        class SplatfactoModelConfig:
            _target: Type = field(default_factory=lambda: SplatfactoModel)
            ssim_lambda: float = 0.2
            background_color: str = "random"

        class SplatfactoModel:
            device = "cpu"

            def __init__(self, config):
                self.config = config

            def _downscale_if_required(self, image):
                return image[::2, ::2]

            def get_gt_img(self, image):
                if image.dtype == torch.uint8:
                    image = image.float() / 255.0
                return self._downscale_if_required(image).to(self.device)

            def composite_with_background(self, image, background):
                if image.shape[2] == 4:
                    alpha = image[..., -1:].repeat((1, 1, 3))
                    return alpha * image[..., :3] + (1 - alpha) * background
                return image

            def get_loss_dict(self, outputs, batch, metrics_dict=None):
                gt_img = self.composite_with_background(self.get_gt_img(batch["image"]), outputs["background"])
                pred_img = outputs["rgb"]
                if "mask" in batch:
                    mask = self._downscale_if_required(batch["mask"])
                    gt_img, pred_img = gt_img * mask, pred_img * mask
                Ll1 = torch.abs(gt_img - pred_img).mean()
                simloss = ((gt_img - pred_img) ** 2).mean()
                return {
                    "main_loss": (1 - self.config.ssim_lambda) * Ll1 + self.config.ssim_lambda * simloss,
                    "scale_reg": torch.tensor(0.0),
                }
        """,
    # As in nerfstudio, the list of methods asks for plugins while it is being made.
    "nerfstudio/configs/method_configs.py": """
        import importlib
        from dataclasses import dataclass
        from typing import Any
        from nerfstudio.models.splatfacto import SplatfactoModelConfig
        from nerfstudio.plugins.types import MethodSpecification

        @dataclass
        class Pipeline:
            model: Any

        @dataclass
        class TrainerConfig:
            method_name: str
            pipeline: Pipeline

        method_configs = {"splatfacto": TrainerConfig("splatfacto", Pipeline(SplatfactoModelConfig()))}

        def discover():
            found = getattr(importlib.import_module("legs_adapters.upstreams.nerfstudio"), "splatfacto_legs")
            assert isinstance(found, MethodSpecification)
            return {found.config.method_name: found.config}

        all_methods = {**method_configs, **discover()}
        """,
}


@pytest.fixture
def nerfstudio(tmp_path, monkeypatch):
    """A stand-in for nerfstudio on sys.path; forgotten afterwards."""
    for path, text in FAKE.items():
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(textwrap.dedent(text))
    monkeypatch.syspath_prepend(str(tmp_path))
    for name in [name for name in os.environ if name.startswith("LEGS_")]:
        monkeypatch.delenv(name)
    state.reset()
    monkeypatch.setattr(sys, "argv", ["ns-train"])
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    for name in list(sys.modules):
        if name.split(".")[0] == "nerfstudio" or name == "legs_adapters.upstreams.nerfstudio":
            del sys.modules[name]
    # `from legs_adapters.upstreams import nerfstudio` asks the package before it asks sys.modules.
    vars(importlib.import_module("legs_adapters.upstreams")).pop("nerfstudio", None)


def models():
    from nerfstudio.configs.method_configs import all_methods

    configs = [all_methods[name].pipeline.model for name in ("splatfacto", "splatfacto-legs")]
    return [config._target(config) for config in configs]


def step(mask=False, alpha=False):
    batch = {"image": torch.rand(12, 16, 4 if alpha else 3)}
    if mask:
        batch["mask"] = (torch.rand(12, 16, 1) > 0.3).float()
    outputs = {"rgb": torch.rand(6, 8, 3, requires_grad=True), "background": torch.rand(3)}
    return outputs, batch


@pytest.mark.parametrize("settings", [{}, {"mask": True}, {"alpha": True}])
def test_only_the_l1_share_of_the_main_loss_differs(nerfstudio, settings):
    own, legs = models()
    outputs, batch = step(**settings)
    before, after = own.get_loss_dict(outputs, batch), legs.get_loss_dict(outputs, batch)
    assert sorted(before) == sorted(after)
    assert torch.equal(before["scale_reg"], after["scale_reg"])
    target = own.composite_with_background(own.get_gt_img(batch["image"]), outputs["background"])
    mask = batch["mask"][::2, ::2] if "mask" in batch else 1.0
    error = torch.abs(outputs["rgb"] * mask - target * mask)
    excess = (weight_map(target * mask, "legs", channels_last=True) * error).mean() - error.mean()
    assert torch.allclose(after["main_loss"] - before["main_loss"], 0.8 * excess, atol=1e-6)
    assert excess > 0.01


def test_off_and_evaluation_are_splatfacto_s_own_to_the_last_bit(nerfstudio, monkeypatch):
    own, legs = models()
    outputs, batch = step()
    with torch.no_grad():
        evaluated = dict(outputs, rgb=outputs["rgb"].detach())
        assert torch.equal(
            own.get_loss_dict(evaluated, batch)["main_loss"], legs.get_loss_dict(evaluated, batch)["main_loss"]
        )
    monkeypatch.setenv("LEGS_OFF", "1")
    state.reset()
    losses = [model.get_loss_dict(outputs, batch)["main_loss"] for model in (own, legs)]
    assert torch.equal(*losses)
    assert torch.equal(*(torch.autograd.grad(loss, outputs["rgb"])[0] for loss in losses))


def test_settings_are_flags_of_ns_train(nerfstudio):
    import dataclasses

    from legs_adapters.upstreams import nerfstudio as plugin
    from nerfstudio.configs.method_configs import all_methods

    config = all_methods["splatfacto-legs"].pipeline.model
    assert type(config) is plugin.SplatfactoLegsModelConfig
    assert (config.legs_preset, config.legs_beta, config.legs_curve) == (None, None, None)
    assert dataclasses.asdict(config)["background_color"] == "random"
    outputs, batch = step()
    losses = {}
    for flags in ({}, {"legs_beta": 0.0}, {"legs_preset": "legs-l"}, {"legs_curve": "C1", "legs_beta": 10.0}):
        state.reset()
        given = dataclasses.replace(config, **flags)
        losses[str(flags)] = float(given._target(given).get_loss_dict(outputs, batch)["main_loss"].detach())
    legs, off, linear, same = losses.values()
    own = float(models()[0].get_loss_dict(outputs, batch)["main_loss"].detach())
    assert off == pytest.approx(own, rel=1e-6)
    assert linear == pytest.approx(same, rel=1e-6)
    assert legs > linear > off
    given = dataclasses.replace(config, legs_curve="C77")
    with pytest.raises(LegsError, match="C77"):
        given._target(given)


def test_the_method_is_splatfacto_s_but_for_its_name_and_model(nerfstudio):
    from nerfstudio.configs.method_configs import all_methods
    from nerfstudio.models.splatfacto import SplatfactoModel

    assert sorted(all_methods) == ["splatfacto", "splatfacto-legs"]
    assert all_methods["splatfacto"].pipeline.model._target is SplatfactoModel
    model = all_methods["splatfacto-legs"].pipeline.model
    assert issubclass(model._target, SplatfactoModel)
    assert model.background_color == "random"


def test_the_model_is_found_under_the_name_that_a_run_s_config_keeps(nerfstudio):
    from legs_adapters.upstreams import nerfstudio as plugin
    from nerfstudio.configs.method_configs import all_methods

    target = all_methods["splatfacto-legs"].pipeline.model._target
    assert getattr(sys.modules[target.__module__], target.__qualname__) is target
    assert plugin.SplatfactoLegsModel is target


@pytest.mark.parametrize("first", ["legs_adapters.upstreams.nerfstudio", "nerfstudio.configs.method_configs"])
def test_whichever_is_imported_first(nerfstudio, first):
    program = (
        f"import {first}\n"
        "from legs_adapters.upstreams import nerfstudio as plugin\n"
        "from nerfstudio.configs.method_configs import all_methods\n"
        "assert plugin.splatfacto_legs.config.method_name == 'splatfacto-legs'\n"
        "assert plugin.SplatfactoLegsModel is all_methods['splatfacto-legs'].pipeline.model._target\n"
    )
    done = run([sys.executable, "-c", program], cwd=nerfstudio, env=legs_environment())
    assert done.returncode == 0, done.stderr


def test_without_nerfstudio_nothing_of_it_is_imported():
    program = (
        "import sys, legs_adapters.upstreams.nerfstudio as plugin\n"
        "assert 'nerfstudio' not in sys.modules\n"
        "try:\n    plugin.splatfacto_legs\nexcept ModuleNotFoundError as error:\n    print(error.name)\n"
        "print(hasattr(plugin, 'something_else'))\n"
    )
    done = run([sys.executable, "-c", program], env=legs_environment())
    assert done.stdout.split() == ["nerfstudio", "False"], done.stderr


def test_the_package_offers_the_method():
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    section = text.split('[project.entry-points."nerfstudio.method_configs"]')[1].split("[")[0]
    assert 'splatfacto-legs = "legs_adapters.upstreams.nerfstudio:splatfacto_legs"' in section
