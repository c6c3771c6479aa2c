"""The L1 terms that are patched, and the reasons of those that are skipped, in scripts shaped as real ones."""

from __future__ import annotations

import re

import pytest
from legs_adapters.code.sources import decode
from legs_adapters.plan import plan
from legs_adapters.terms.findings import Line
from legs_adapters.terms.functions import L1Functions

from legs_loss import LegsError
from tests.patcher.support import NAMES, SITE, checkout, expected, files, legs_patch, options

MASKS = re.compile(r"\s*\w+ = legs_loss\.masked\(")


def changed_lines(found, path):
    """Return the lines of a file after the patch, without those that it adds: numbered as before."""
    lines = decode(path, found.after[path]).text.splitlines()
    return [line for line in lines if not line.startswith("import legs_loss") and not MASKS.match(line)]


@pytest.fixture(scope="module", params=NAMES)
def case(request, tmp_path_factory):
    """A script's name, its files, its checkout, which stays as it is, and its plan."""
    texts = files(request.param)
    root = checkout(tmp_path_factory.mktemp("case"), texts)
    return request.param, texts, root, plan(root, **options(request.param))


def test_every_term_gets_the_verdict_that_its_comment_asks_for(case):
    _, texts, _, found = case
    verdicts = {}
    for site in (site for site in found.findings.sites if site.form.term != "mask"):
        becomes = "fused" if site.form.term else "weighted"
        verdicts[site.path, site.line] = becomes, changed_lines(found, site.path)[site.line - 1].strip()
    for use, _ in found.findings.unweighted:
        verdicts[use.left.path, use.left.line] = "plain", changed_lines(found, use.left.path)[use.left.line - 1].strip()
    for entry in found.findings.left:
        verdicts.setdefault((entry.path, entry.line), ("left", entry.reason))
    for entry in found.findings.problems:
        verdicts[entry.path, entry.line] = "error", entry.reason
    wanted = expected(texts)
    assert {where: verdict for where, (verdict, _) in verdicts.items()} == {
        where: verdict for where, (verdict, _) in wanted.items()
    }
    for where, (verdict, detail) in wanted.items():
        if verdict == "error":
            assert detail in verdicts[where][1]
        else:
            assert verdicts[where][1] == detail


@pytest.mark.parametrize("name", [name for name in NAMES if name.startswith("masks")])
def test_the_line_of_masks_is_written_where_its_comment_says(name, tmp_path):
    texts = files(name)
    found = plan(checkout(tmp_path, texts), masks=True)
    written, waiting, plain = {}, "", 1
    for line in found.after["train.py"].decode().splitlines():
        if MASKS.match(line):
            waiting = line.strip()
        elif not line.startswith("import legs_loss"):
            if waiting and not line.lstrip().startswith("#"):
                written["train.py", plain], waiting = ("masked", waiting), ""
            plain += 1
    assert written == expected(texts, masked=True)


def test_the_patched_files_compile_and_a_second_patch_finds_nothing(case, tmp_path):
    name, texts, _, found = case
    for path, data in found.after.items():
        compile(data, path, "exec")
    assert plan(checkout(tmp_path, {**texts, **found.after}), **options(name)).after == {}


def test_a_checkout_without_a_word_of_gaussians_has_no_term_to_decide(tmp_path):
    text = "import torch\n\n\ndef train(net, data, optimizer):\n    for image, gt_image in data:\n"
    text += (
        "        loss = torch.abs(net(image) - gt_image).mean()\n        loss.backward()\n        optimizer.step()\n"
    )
    found = plan(checkout(tmp_path, {"nets/train.py": text})).findings
    assert [entry.rule for entry in found.left] == ["not-splats"]
    assert not found.problems
    found = plan(checkout(tmp_path, {"scene/model.py": "gaussian_model = None\n"})).findings
    assert [problem.line for problem in found.problems] == [6]


def test_in_place_every_line_keeps_its_number(case):
    name, _, root, on_disk = case
    here = plan(root, in_place=True, **options(name))
    assert sorted(here.after) == sorted(on_disk.after)
    for path, data in here.after.items():
        before = (root / path).read_bytes()
        if name != "masks_in_other_shapes_masked":  # between two compound statements a line of masks is its own
            assert data.count(b"\n") == before.count(b"\n")
        edits, others = (
            [edit for edit in made.edits[path] if not re.search(rb"import legs_loss|legs_loss.masked", edit.after)]
            for made in (here, on_disk)
        )
        assert edits == others


@pytest.mark.parametrize("line", ["\n\ndef legs_loss(pose):\n    return pose\n", "import math as legs_loss\n"])
def test_a_name_that_is_taken_is_one_error(line, tmp_path):
    texts = files("inria")
    texts["train.py"] += line
    with pytest.raises(LegsError, match=r"train.py has a legs_loss of its own: rename it"):
        plan(checkout(tmp_path, texts))


def test_a_site_chosen_by_hand_is_the_only_one(tmp_path):
    root = checkout(tmp_path, files("non_photometric_l1_left"))
    lines = files("non_photometric_l1_left")["train.py"].splitlines()
    line = lines.index("        Ll1 = l1_loss(rendered, target_image)") + 1
    found = plan(root, by_hand=[("train.py", line)])
    assert [(site.path, site.line) for site in found.findings.sites] == [("train.py", line)]


@pytest.mark.parametrize("place", [0, 1, 2])
def test_of_several_terms_on_a_line_that_is_chosen_by_hand_the_photometric_one_is_weighted(place, tmp_path):
    others = ["l1_loss(render_pkg['depth'], viewpoint_cam.depth)", "l1_loss(render_pkg['alpha'], viewpoint_cam.mask)"]
    texts = files("inria")
    for proven, ours in ((True, "l1_loss(image, gt_image)"), (False, "l1_loss(image, opt.other)")):
        terms = " + ".join([*others[:place], ours, *others[place:]])
        after = " + ".join([*others[:place], f"legs_loss.{ours}", *others[place:]])
        root = checkout(
            tmp_path / str(proven), {**texts, "train.py": texts["train.py"].replace(SITE, f"        Ll1 = {terms}\n")}
        )
        line = (root / "train.py").read_text().splitlines().index(f"        Ll1 = {terms}") + 1
        found = plan(root, by_hand=[("train.py", line)])
        assert changed_lines(found, "train.py")[line - 1] == f"        Ll1 = {after}"
        assert [site.line for site in found.findings.sites] == [line]


def test_a_vendored_network_that_is_not_about_splats_is_left(tmp_path):
    texts = files("inria")
    texts["depth_network/train.py"] = (
        "import torch\n\n\n"
        "def step(network, batch):\n"
        "    predicted_img = network(batch['input'])\n"
        "    img = batch['image']\n"
        "    loss = torch.nn.functional.l1_loss(predicted_img, img)\n"
        "    loss.backward()\n"
    )
    found = plan(checkout(tmp_path, texts))
    assert [site.path for site in found.findings.sites] == ["train.py"]
    assert ("depth_network/train.py", "unrelated") in [(entry.path, entry.reason) for entry in found.findings.left]


def test_a_proven_photograph_is_told_from_one_that_only_its_name_shows(tmp_path):
    texts = files("inria")
    texts["step.py"] = (
        "from gaussian_renderer import render\nfrom utils.loss_utils import l1_loss, ssim\n\n\n"
        "def called(image, other):\n    return l1_loss(image, other) + 0.2 * (1 - ssim(image, other))\n\n\n"
        "def handed(gaussians, cam, gt_image, pipe, background):\n"
        "    image = render(cam, gaussians, pipe, background)['render']\n"
        "    l1_loss(image, gt_image).backward()\n    gaussians.optimizer.step()\n\n\n"
        "def step(gaussians, cam, pipe, background):\n"
        "    image = render(cam, gaussians, pipe, background)['render']\n"
        "    called(image, cam.original_image.cuda()).backward()\n    gaussians.optimizer.step()\n"
    )
    found = plan(checkout(tmp_path, texts))
    assert {site.scope.name: site.why for site in found.findings.sites if site.path == "step.py"} == {
        "called": "other is the photograph",
        "handed": "gt_image is a parameter, the photograph by its name",
    }


def test_a_value_with_very_many_ways_to_come_about_is_followed_once(tmp_path):
    # Each branch doubles the ways: 2^30 of them, if each were gone for itself.
    branches = "".join(f"        if opt.stage > {k}:\n            image += opt.noise\n" for k in range(30))
    texts = files("inria")
    before, line, after = texts["train.py"].partition("        gt_image = viewpoint_cam.original_image.cuda()\n")
    texts["train.py"] = before + branches + line + after
    found = plan(checkout(tmp_path, texts))
    assert [site.why for site in found.findings.sites] == ["gt_image is the photograph"]


def test_functions_that_call_each_other_are_each_looked_into_once(tmp_path, monkeypatch):
    names = [f"l1_of_{k}" for k in range(8)]
    bodies = {name: "".join(f"    total += {other}(a, b)\n" for other in names if other != name) for name in names}
    functions = "".join(f"def {name}(a, b, total=0):\n{body}    return total\n\n\n" for name, body in bodies.items())
    texts = files("inria")
    texts["utils/loss_utils.py"] += f"\n\n{functions}def mean_of(a, b):\n    return l1_loss(a, b) + l1_of_0(a, b)\n"
    texts["train.py"] = texts["train.py"].replace("l1_loss", "mean_of")
    looked_into = []
    compares = L1Functions._compares_only
    monkeypatch.setattr(L1Functions, "_compares_only", lambda *args: looked_into.append(args[1]) or compares(*args))
    plan(checkout(tmp_path, texts))
    assert len(looked_into) == len(set(looked_into)) >= len(names)


def test_a_script_that_trains_without_a_site_is_named_beside_the_sites_of_others(tmp_path):
    distils = (
        "from gaussian_renderer import render\nfrom utils.loss_utils import l1_loss\n\n\n"
        "def refine(scene, student, teacher):\n    for cam in scene:\n"
        '        image, target = render(cam, student, 0, 0)["render"], render(cam, teacher, 0, 0)["render"]\n'
        "        loss = l1_loss(image, target)\n        loss.backward()\n"
    )
    texts = files("inria")
    texts["refine.py"] = distils
    texts["train.py"] += distils.replace("def refine", "def refine_too")
    found = plan(checkout(tmp_path, texts))
    assert {site.path for site in found.findings.sites} == {"train.py"}
    assert [(doubt.path, doubt.line) for doubt in found.findings.doubts] == [("refine.py", 8)]
    done = legs_patch("--diff", tmp_path)
    assert done.returncode == 0
    assert "warning: a possible loss was not weighted: refine.py:8" in done.stderr


def test_the_advice_for_a_body_that_serves_two_purposes_is_no_line_to_copy(tmp_path):
    texts = {
        "losses.py": (
            "from torch import nn\n\n\n"
            "class MaskedL1(nn.Module):\n    def __init__(self):\n        super().__init__()\n"
            '        self.l1_loss = nn.L1Loss(reduction="none")\n\n    def forward(self, pred, target, mask):\n'
            "        return self.l1_loss(pred, target) * mask + self.ssim(pred, target)\n"
        ),
        "train.py": (
            "from gaussian_renderer import render\nfrom losses import MaskedL1\n\n\ndef training(scene, gaussians):\n"
            "    pictures, depths = MaskedL1(), MaskedL1()\n    for cam in scene:\n"
            "        package = render(cam, gaussians, None, None)\n"
            '        loss = pictures(package["render"], cam.original_image, cam.valid).mean()\n'
            '        loss += depths(package["extra"], cam.extra(), cam.valid).mean()\n        loss.backward()\n'
        ),
    }
    (problem,) = plan(checkout(tmp_path, texts)).findings.problems
    assert (problem.by_site, problem.advice) == (
        False,
        "give the loss a function of its own, and weight the L1 in that one",
    )


def test_a_difference_that_is_filtered_before_its_absolute_value_is_quoted(tmp_path):
    texts = files("inria")
    texts["train.py"] = texts["train.py"].replace(
        "        Ll1 = l1_loss(image, gt_image)\n",
        "        delta = image - gt_image\n"
        "        if opt.clamp > 0:\n"
        "            delta = delta[delta ** 2 < opt.clamp]\n"
        "        Ll1 = delta.abs().mean()\n",
    )
    [problem] = plan(checkout(tmp_path, texts)).findings.problems
    assert problem.text == "Ll1 = delta.abs().mean()"
    assert problem.reason == "image - gt_image may change before its absolute value is taken"
    assert not problem.by_site
    assert "legs_loss" not in problem.advice


def test_a_method_is_not_resolved_by_its_bare_name(tmp_path):
    texts = files("inria")
    texts["losses.py"] = (
        "import torch\n\n\nclass L1Loss(torch.nn.Module):\n"
        "    def forward(self, prediction, target):\n        return torch.abs(prediction - target).mean()\n"
    )
    texts["train.py"] = texts["train.py"].replace(
        "        loss = ", "        extra = lpips_model.forward(image, gt_image)\n        loss = extra + ", 1
    )
    found = plan(checkout(tmp_path, texts)).findings
    assert [site.form.callee.id for site in found.sites] == ["l1_loss"]
    assert found.problems == []


@pytest.mark.parametrize(("kind", "attribute"), [("VGGPerceptualLoss", "extra"), ("Features", "vgg_l1")])
def test_a_perceptual_loss_is_no_l1_by_its_name_or_its_class(tmp_path, kind, attribute):
    texts = files("inria")
    texts["losses.py"] = (
        f"import torch\n\n\nclass {kind}(torch.nn.Module):\n"
        "    def forward(self, x, y):\n        return torch.nn.functional.l1_loss(self.vgg(x), self.vgg(y))\n\n\n"
        f"class Losses:\n    def __init__(self):\n        self.{attribute} = {kind}()\n\n"
        f"    def all(self, image, gt_image):\n        return self.{attribute}(image[None], gt_image[None])\n"
    )
    texts["train.py"] = texts["train.py"].replace(
        "        loss = ", "        extra = Losses().all(image, gt_image)\n        loss = extra + ", 1
    )
    texts["train.py"] = texts["train.py"].replace("import torch\n", "import torch\nfrom losses import Losses\n", 1)
    found = plan(checkout(tmp_path, texts)).findings
    assert [site.form.callee.id for site in found.sites] == ["l1_loss"]
    assert found.problems == []


def test_a_function_that_is_passed_by_name_is_left_where_that_name_stands(tmp_path):
    """Its call stands in another file, and has more lines before it."""
    texts = files("inria")
    texts["losses.py"] = (
        "from utils.loss_utils import l1_loss, l2_loss\n\n\nclass Losses:\n    def __init__(self, kind):\n"
        "        if kind:\n            self.compare = l1_loss\n        else:\n            self.compare = l2_loss\n"
    )
    texts["codes.py"] = "# splats\n" * 40 + (
        "from losses import Losses\n\n\ndef training(model, cams):\n    losses = Losses(1)\n    for cam in cams:\n"
        "        loss = losses.compare(model.code(cam), cam.code)\n        loss.backward()\n"
    )
    found = plan(checkout(tmp_path, texts)).findings
    (left,) = [entry for entry in found.left if entry.path == "losses.py"]
    assert (left.line, left.text, left.rule) == (7, "self.compare = l1_loss", "unknown")
    assert left.because == (Line("losses.py", 7, "self.compare = l1_loss"),)


def test_depth_by_another_name_is_left(tmp_path):
    texts = files("inria")
    texts["losses.py"] = (
        "import torch\nfrom utils.loss_utils import l1_loss\n\n\n"
        "def masked_rgb_l1(rgb, photo, mask):\n    return (rgb - photo).abs()[:, mask].mean()\n\n\n"
        "def range_loss(prediction_range_m, target_range_m, mask):\n"
        "    return (prediction_range_m[mask] - target_range_m[mask]).abs().mean()\n"
    )
    texts["train.py"] = texts["train.py"].replace(
        "        loss = ",
        "        lidar = range_loss(package['render'][0, ..., 3], viewpoint_cam.sensor, viewpoint_cam.mask)\n"
        "        lidar = lidar + torch.abs(package['render'][0, ..., 3] - viewpoint_cam.sensor_z).mean()\n"
        "        loss = lidar + ",
        1,
    )
    texts["train.py"] = texts["train.py"].replace("import torch\n", "import torch\nfrom losses import range_loss\n", 1)
    found = plan(checkout(tmp_path, texts)).findings
    assert [(site.path, site.form.callee is not None) for site in found.sites] == [("train.py", True)]
    assert found.problems == []


CLASS = """import torch.nn.functional as F
from torch import nn
from gaussian_renderer import render


class {name}(nn.Module):
    def forward(self, {a}, {b}):
        return F.l1_loss({a}, {b}) + 0.1 * {a}.mean()


def training(cams, gaussians):
    loss_fn = {name}()
    for cam in cams:
        package = render(cam, gaussians, None, None)
        loss = loss_fn({given})
        loss.backward()
        gaussians.optimizer.step()
"""


@pytest.mark.parametrize("name", ["DepthGuidedLoss", "RateDistortionLoss", "NormalLoss"])
@pytest.mark.parametrize("sides", [("rendered_image", "gt_image"), ("a", "b")])
def test_the_name_of_a_class_outweighs_neither_its_parameters_nor_what_they_are_given(name, sides, tmp_path):
    text = CLASS.format(name=name, a=sides[0], b=sides[1], given='package["render"], cam.original_image')
    found = plan(checkout(tmp_path, {"train.py": text})).findings
    assert [(site.line, site.why) for site in found.sites] == [(8, f"{sides[1]} is the photograph")]


def test_a_reason_by_the_name_of_a_class_quotes_the_class(tmp_path):
    text = CLASS.format(name="DepthLoss", a="a", b="b", given="package.one, cam.other")
    found = plan(checkout(tmp_path, {"train.py": text})).findings
    because = [line.text for left in found.left if left.rule == "depth" for line in left.because]
    assert found.sites == []
    assert because == ["class DepthLoss(nn.Module):"]


def test_a_product_with_the_photograph_is_not_said_to_be_the_photograph(tmp_path):
    texts = files("inria")
    texts["train.py"] = texts["train.py"].replace(
        "l1_loss(image, gt_image)\n        loss", "l1_loss(image * attention, gt_image * attention)\n        loss"
    )
    whys = [site.why for site in plan(checkout(tmp_path, texts)).findings.sites]
    assert whys == ["gt_image * attention is made from the photograph"]


def test_a_function_that_is_weighted_by_hand_is_not_weighted_again_at_its_calls(tmp_path):
    texts = files("inria")
    body = "import legs_loss\n\n\ndef l1_loss(network_output, gt):\n    return legs_loss.l1_loss(network_output, gt)\n"
    found = plan(checkout(tmp_path, {**texts, "utils/loss_utils.py": body})).findings
    assert not found.sites
    assert [(entry.path, entry.line) for entry in found.patched] == [("utils/loss_utils.py", 5)]
