"""Arguments of another type than a public function takes: one error of the package, which names the argument."""

from __future__ import annotations

import pytest
import torch

import legs_loss
from legs_loss import LegsError

NEITHER = [3, "text", b"x", 2.5, [1], {}, None, object()]  # no image, function, folder, name or flag, less what is one
IMAGES = {name: ("prediction", "target") for name in ("l1_loss", "legs_loss", "weighted_l1", "d_ssim")}
IMAGES.update(masked=("prediction", "target"), coverage=("prediction", "target"))
IMAGES.update(ssim=("img1", "img2"), response=("image",), weight_map=("image",))
# Arguments of functions, each with those of NEITHER that it takes.
OTHERS = {
    ("l1_loss", "own"): [None],
    ("l1_loss", "reduction"): [],
    ("l1_loss", "mask"): [None],
    ("legs_loss", "weight"): [None],
    ("legs_loss", "lambda_dssim"): [],
    ("legs_loss", "padding"): [],
    ("legs_loss", "spec"): [],
    ("ssim", "window_size"): [3],
    ("ssim", "padding"): [],
    ("d_ssim", "padding"): [],
    ("response", "operator"): [],
    ("response", "p"): [],
    ("response", "smooth"): [3, 2.5],
    ("weight_map", "spec"): [],
    ("weight_map", "scene"): [None],
    **{(name, "channels_last"): [None] for name in IMAGES if name not in ("masked", "coverage")},
    ("configure", "spec"): [None],
    ("configure", "store"): ["text", None],
    ("configure", "memo_bytes"): [3],
    ("register_curve", "name"): ["text"],
    ("register_curve", "function"): [],
    ("unweighted", "function"): [],
    ("apply_to", "library"): [],
    ("LEGSLoss", "spec"): [],
    ("LEGSLoss", "lambda_dssim"): [],
    ("LEGSLoss", "padding"): [],
    ("LEGSLoss", "store"): ["text", None],
    **{("WeightSpec", name): [] for name in ("operator", "p", "curve", "normalise", "over")},
    **{("WeightSpec", name): [3, 2.5] for name in ("beta", "percentile", "eps", "smooth")},
}


def given(function):
    """The arguments of a call that is right."""
    images = {name: torch.rand(3, 12, 12, requires_grad=i == 0) for i, name in enumerate(IMAGES.get(function, ()))}
    return {"name": "of-a-test", "function": abs} if function == "register_curve" else images


@pytest.mark.parametrize(("function", "argument"), OTHERS, ids=lambda name: name)
def test_of_another_type(function, argument):
    for wrong in NEITHER:
        if not any(type(wrong) is type(right) and wrong == right for right in OTHERS[function, argument]):
            with pytest.raises(LegsError) as raised:
                getattr(legs_loss, function)(**{**given(function), argument: wrong})
            assert repr(wrong) in str(raised.value) or f"got {type(wrong).__name__}" in str(raised.value)


@pytest.mark.parametrize(("function", "image"), [(name, image) for name in IMAGES for image in IMAGES[name]])
def test_what_is_no_image(function, image):
    for wrong in NEITHER:
        with pytest.raises(LegsError, match=r"must be a torch\.Tensor, got"):
            getattr(legs_loss, function)(**{**given(function), image: wrong})
    if function not in ("masked", "coverage"):  # without masks they change nothing
        with pytest.raises(LegsError, match=r"is sparse: give .*\.to_dense"):
            getattr(legs_loss, function)(**{**given(function), image: torch.rand(3, 12, 12).to_sparse()})


def test_an_evaluation_whose_images_do_not_fit():
    for prediction in (torch.rand(3, 5, 12), torch.rand(3, 12, 12, device="meta")):
        with pytest.raises(LegsError, match=r"differ in shape|prediction is on meta"):
            legs_loss.l1_loss(prediction, torch.rand(3, 12, 12))
    image, target = torch.rand(3, 12, 12), torch.rand(3, 1, 1)
    assert torch.equal(legs_loss.l1_loss(image, target), (image - target).abs().mean())  # what torch takes is its own


def test_settings_of_a_number_beyond_its_range():
    for smooth in (-1.0, float("nan"), 1e9):
        with pytest.raises(LegsError, match=r"smooth must be in \[0, 100\]"):
            legs_loss.response(torch.rand(3, 12, 12), smooth=smooth)
    for share in (-0.1, 1.5, float("nan")):
        with pytest.raises(LegsError, match="lambda_dssim must be in"):
            legs_loss.LEGSLoss(lambda_dssim=share)
    with pytest.raises(LegsError, match="no padding is named 'none'"):
        legs_loss.legs_loss(*given("l1_loss").values(), padding="none", lambda_dssim=0.0)
