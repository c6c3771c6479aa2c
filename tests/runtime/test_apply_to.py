"""legs_loss.apply_to: libraries that hold a loss, as small stand-ins with the parts that are replaced."""

from __future__ import annotations

import importlib.util
import sys
import textwrap

import pytest
import torch

import legs_loss
from legs_loss import LegsError, weight_map
from tests.patcher.test_nerfstudio import FAKE as NERFSTUDIO
from tests.support import start_run

GSPLAT = {
    "gsplat/__init__.py": "",
    "gsplat/losses.py": """
        import torch.nn.functional as F

        def l1_loss(pred, target):
            return F.l1_loss(pred, target, reduction="none")

        def ssim_loss(pred, target, padding="valid"):
            return (pred - target).square().mean()
        """,
    "trainer.py": "from gsplat.losses import l1_loss",  # a script that imported it before
}


@pytest.fixture
def library(tmp_path, monkeypatch):
    """Write a package to a folder on sys.path; everything is forgotten afterwards."""
    start_run(monkeypatch, tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    before = set(sys.modules)

    def write(files):
        for path, text in files.items():
            (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / path).write_text(textwrap.dedent(text))
        importlib.invalidate_caches()

    yield write
    for applied in list(importlib.import_module("legs_loss.upstreams")._applied.values()):
        applied.undo()
    for name in set(sys.modules) - before:
        if name.split(".")[0] in ("gsplat", "trainer", "nerfstudio") or name == "legs_adapters.upstreams.nerfstudio":
            del sys.modules[name]


def pair(*shape):
    return torch.rand(shape).requires_grad_(True), torch.rand(shape)


class TestGsplat:
    @pytest.mark.parametrize("shape", [(7, 5, 3), (2, 7, 5, 3), (3, 7, 5), (2, 3, 7, 5)])
    def test_a_rendering_that_trains_is_weighted(self, library, shape):
        library(GSPLAT)
        import trainer
        from gsplat import losses

        with legs_loss.apply_to_gsplat():
            prediction, target = pair(*shape)
            last = shape[-1] == 3
            images = target if target.dim() == 4 else target[None]
            weight = torch.stack([weight_map(image, "legs", channels_last=last) for image in images])
            wanted = weight.reshape(-1, *weight.shape[1:]) * torch.abs(prediction - target)
            for function in (losses.l1_loss, trainer.l1_loss):
                torch.testing.assert_close(function(prediction, target), wanted.reshape(shape))

    def test_what_is_no_photograph_stays_plain(self, library):
        library(GSPLAT)
        from gsplat import losses

        legs_loss.apply_to("gsplat")
        depth, measured = pair(1, 7, 5, 1)
        points, others = pair(100, 3)
        image, target = pair(1, 7, 5, 3)
        for prediction, truth in ((depth, measured), (points, others), (image.detach(), target), (image, image * 0.5)):
            assert torch.equal(losses.l1_loss(prediction, truth), torch.abs(prediction - truth))

    def test_legs_off_is_gsplat_s_own_to_the_last_bit(self, library, monkeypatch):
        library(GSPLAT)
        monkeypatch.setenv("LEGS_OFF", "1")
        from gsplat import losses

        own = losses.l1_loss
        legs_loss.apply_to_gsplat()
        prediction, target = pair(1, 7, 5, 3)
        assert torch.equal(losses.l1_loss(prediction, target), own(prediction, target))

    def test_undo_puts_back_what_was_there(self, library):
        library(GSPLAT)
        import trainer
        from gsplat import losses

        own = losses.l1_loss
        applied = legs_loss.apply_to_gsplat()
        assert legs_loss.apply_to_gsplat() is applied and losses.l1_loss is not own
        assert trainer.l1_loss is losses.l1_loss and losses.l1_loss.__name__ == "l1_loss"
        applied.undo()
        applied.undo()
        assert losses.l1_loss is own and trainer.l1_loss is own
        assert legs_loss.apply_to_gsplat() is not applied


class TestNerfstudio:
    def test_splatfacto_s_own_loss_is_weighted_once(self, library):
        library(NERFSTUDIO)
        from nerfstudio.configs.method_configs import all_methods
        from nerfstudio.models.splatfacto import SplatfactoModel, SplatfactoModelConfig

        batch = {"image": torch.rand(14, 10, 3)}
        outputs = {"rgb": torch.rand(7, 5, 3).requires_grad_(True), "background": torch.zeros(3)}
        legs = all_methods["splatfacto-legs"].pipeline.model._target(SplatfactoModelConfig())
        plain = SplatfactoModel(SplatfactoModelConfig())
        own, wanted = plain.get_loss_dict(outputs, batch)["main_loss"], legs.get_loss_dict(outputs, batch)["main_loss"]
        assert wanted > own
        with legs_loss.apply_to_nerfstudio():
            assert plain.get_loss_dict(outputs, batch)["main_loss"] == wanted
            assert legs.get_loss_dict(outputs, batch)["main_loss"] == wanted
            with torch.no_grad():
                assert plain.get_loss_dict(outputs, batch)["main_loss"] == own
        assert plain.get_loss_dict(outputs, batch)["main_loss"] == own


class TestErrors:
    @pytest.mark.skipif(importlib.util.find_spec("gsplat") is not None, reason="it is installed")
    def test_a_library_that_is_not_installed(self):
        with pytest.raises(LegsError, match="gsplat is not installed"):
            legs_loss.apply_to_gsplat()

    def test_a_version_without_that_loss(self, library):
        library({"gsplat/__init__.py": ""})  # as gsplat 1.5.3
        with pytest.raises(LegsError, match=r"this gsplat does not have the expected loss: .*gsplat\.losses"):
            legs_loss.apply_to_gsplat()
        library({"gsplat/losses.py": ""})
        with pytest.raises(LegsError, match=r"this gsplat does not have the expected loss: .*l1_loss"):
            legs_loss.apply_to_gsplat()

    def test_a_name_that_nobody_registered(self):
        with pytest.raises(LegsError, match=r"unknown library 'gsplatt'; known are gsplat, nerfstudio"):
            legs_loss.apply_to("gsplatt")
        with pytest.raises(AttributeError):
            legs_loss.apply_to_gsplatt  # noqa: B018
