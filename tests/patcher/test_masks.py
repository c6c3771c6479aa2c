"""`legs-patch --masks` on a small script that trains on the CPU, from a scene with masks: every term is masked."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest
import torch
from PIL import Image

import legs_loss
from tests.patcher.support import checkout, files, legs_patch, snapshot
from tests.preloaded import run
from tests.support import legs, legs_environment

LINE = "        image = legs_loss.masked(image, gt_image)\n"
SCRIPT = """
import json
import sys

import torch
from gaussian_renderer import render
from scene import Scene
from scene.gaussian_model import GaussianModel
from utils.loss_utils import l1_loss, ssim


def training(source_path):
    gaussians = GaussianModel(3)
    optimizer = torch.optim.SGD([gaussians._xyz], lr=0.1)
    for viewpoint_cam in Scene(source_path).getTrainCameras():
        image = render(viewpoint_cam, gaussians, None, None)["render"]
        image.retain_grad()
        drawn = image
        gt_image = viewpoint_cam.original_image.to("cpu")
        Ll1 = l1_loss(image, gt_image)
        loss = 0.8 * Ll1 + 0.2 * (1.0 - ssim(image, gt_image))
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        print(json.dumps([float(loss).hex(), drawn.grad.abs().sum(0).tolist()]))


if __name__ == "__main__":
    training(sys.argv[2])
"""
FILES = {
    **files("inria"),
    "train.py": SCRIPT,
    "scene/__init__.py": """
from pathlib import Path

import numpy
import torch
from PIL import Image
from scene.cameras import Camera


class Scene:
    def __init__(self, source_path):
        self.paths = sorted(Path(source_path, "images").iterdir())

    def getTrainCameras(self):
        pixels = [torch.from_numpy(numpy.array(Image.open(path))).float().div(255) for path in self.paths]
        return [Camera(path.stem, one.movedim(-1, 0)) for path, one in zip(self.paths, pixels)]
""",
    "scene/gaussian_model.py": """
import torch


class GaussianModel:
    def __init__(self, sh_degree):
        self._xyz = torch.nn.Parameter(torch.full((3, 16, 20), 0.5))

    def __call__(self, camera):
        return self._xyz * 1.0
""",
}


@pytest.fixture
def scene(tmp_path):
    """Two photographs of noise; of the first the left half does not count. With a store, and without."""
    generator = np.random.default_rng(0)
    for folder in ("images", "masks"):
        (tmp_path / "scene" / folder).mkdir(parents=True)
    for name in ("a", "b"):
        pixels = generator.integers(0, 256, (16, 20, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(tmp_path / "scene" / "images" / f"{name}.png")
    mask = np.full((16, 20), 255, np.uint8)
    mask[:, :10] = 0
    Image.fromarray(mask).save(tmp_path / "scene" / "masks" / "a.png")
    return tmp_path / "scene"


def python(*words, **options):
    done = run([sys.executable, *map(str, words)], env=legs_environment(), check=True, **options)
    return [json.loads(line) for line in done.stdout.splitlines() if line.startswith("[")], done.stderr


def precompute(scene):
    assert legs("precompute", scene, "--masks", "masks", "--workers", 1).returncode == 0


@pytest.mark.slow
def test_a_patched_run_masks_every_term_and_without_masks_nothing_changes(scene, tmp_path):
    plain, masked = (checkout(tmp_path / name, FILES) for name in ("plain", "masked"))
    assert legs_patch(plain).returncode == 0
    before = snapshot(masked)
    assert legs_patch("--masks", masked).returncode == 0
    assert (masked / "train.py").read_text().count(LINE) == 1
    without = [python("train.py", "-s", scene, cwd=root)[0] for root in (plain, masked)]
    assert without[0] == without[1]  # no store: the same to the last bit
    precompute(scene)
    (first, second), said = python("train.py", "-s", scene, cwd=masked)
    gradient = np.array(first[1])
    assert not gradient[:, :10].any() and gradient[:, 10:].all()
    assert np.array(second[1]).all()  # it has no mask
    assert "masks: 1 view(s) masked, 1 without a mask counted whole" in said and "in the L1 alone" not in said
    (first, _), said = python("train.py", "-s", scene, cwd=plain)
    assert np.array(first[1])[:, :10].any() and "in the L1 alone: legs-patch --masks" in said  # by its SSIM
    assert legs_patch("--undo", masked).returncode == 0
    assert snapshot(masked) == before


GT = '        gt_image = viewpoint_cam.original_image.to("cpu")\n'
CHANGE = """
        if viewpoint_cam.image_name == "a":  # a sub-pixel shift, as mip-splatting's
            grid = torch.nn.functional.affine_grid(torch.eye(2, 3)[None], (1, 3, 16, 20), align_corners=False)
            grid = grid + (torch.rand(1, 16, 20, 2) - 0.5) / 16
            gt_image = torch.nn.functional.grid_sample(gt_image[None], grid, align_corners=False)[0]
        else:  # a random background
            alpha = (gt_image.mean(0, keepdim=True) > 0.4).float()
            gt_image = gt_image * alpha + torch.rand(3)[:, None, None] * (1.0 - alpha)
"""


@pytest.mark.slow
def test_a_target_that_changes_from_step_to_step_is_said_and_masked_in_no_term(scene, tmp_path):
    root = checkout(tmp_path / "gs", {**FILES, "train.py": SCRIPT.replace(GT, GT + CHANGE)})
    assert legs_patch("--masks", root).returncode == 0
    text = (root / "train.py").read_text()
    assert text.index(LINE) > text.index(CHANGE)
    precompute(scene)
    rows, said = python("train.py", "-s", scene, cwd=root)
    assert all(np.array(gradient).all() for _, gradient in rows)
    assert said.count("NOT MASKED: ") == 1 and "augmented, shifted, resized or laid on another background" in said
    masks = "legs-loss: masks: 0 view(s) masked, 2 training image(s) were NOT FOUND in the store, so NOT MASKED"
    assert masks in said.splitlines()[-2:]
    done = subprocess.run(
        [sys.executable, "train.py", "-s", str(scene)],
        cwd=root,
        env={**legs_environment(), "LEGS_MASKS": "require"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1 and not done.stdout and "LegsError: NOT MASKED" in done.stderr


@pytest.mark.slow
def test_in_memory(scene, tmp_path):
    precompute(scene)
    root = checkout(tmp_path / "gs", FILES)
    before = snapshot(root)
    (first, _), said = python("-m", "legs_loss", "run", "--masks", root / "train.py", "-s", scene)
    assert not np.array(first[1])[:, :10].any()
    assert "is masked, in every term that gets the rendering, in this run" in said
    assert snapshot(root) == before


def test_a_codebase_that_was_patched_before_gets_the_line_and_nothing_twice(tmp_path):
    root = checkout(tmp_path, FILES)
    before = snapshot(root)
    assert legs_patch(root).returncode == 0
    once = (root / "train.py").read_text()
    diff = legs_patch("--masks", "--diff", root).stdout
    written = [line for line in diff.splitlines() if line[0] in "+-" and line[:3] not in ("+++", "---")]
    assert written == [f"+{LINE.rstrip()}"]
    found = json.loads(legs_patch("--masks", "--json", root).stdout)
    assert [(site["line"], site["term"]) for site in found["sites"]] == [(21, "mask")]
    assert (root / "train.py").read_text().replace(LINE, "") == once
    assert "nothing to do" in legs_patch("--masks", root).stdout
    assert legs_patch("--undo", root).returncode == 0
    assert snapshot(root) == before


def test_a_proven_ssim_becomes_the_mean_over_what_counts(scene, tmp_path):
    of_3dgs = files("ssim_beside_l1_fused")["utils/loss_utils.py"]
    masked = checkout(tmp_path / "masked", {**FILES, "utils/loss_utils.py": of_3dgs})
    assert legs_patch("--masks", masked).returncode == 0
    assert "0.2 * (1.0 - legs_loss.ssim(image, gt_image))" in (masked / "train.py").read_text()
    precompute(scene)
    rows = python("train.py", "-s", scene, cwd=masked)[0]
    # The left half of the first photograph does not count.
    image, target = torch.full((3, 16, 20), 0.5), Image.open(scene / "images" / "a.png")
    target = torch.from_numpy(np.array(target)).float().div(255).movedim(-1, 0)
    image[:, :, :10] = target[:, :, :10]
    l1 = (legs_loss.weight_map(target) * (image - target).abs())[:, :, 10:].mean()
    expected = 0.8 * l1 + 0.2 * legs_loss.d_ssim(image, target) / 0.5
    assert float.fromhex(rows[0][0]) == pytest.approx(float(expected), rel=1e-3)


def test_other_terms_of_both_images_are_named_with_what_corrects_them(tmp_path):
    text = SCRIPT.replace("from utils.loss_utils", "from fused_ssim import fused_ssim\nfrom utils.loss_utils").replace(
        "(1.0 - ssim(image, gt_image))",
        "(1.0 - fused_ssim(image[None], gt_image[None])) + lpips(image, gt_image, 1) + l1_loss(gt_image, drawn)\n"
        "        with torch.no_grad():\n            print(psnr(image, gt_image))",
    )
    root = checkout(tmp_path, {**FILES, "train.py": text.replace("drawn = image", "drawn = image.detach()")})
    found = json.loads(legs_patch("--masks", "--json", root).stdout)
    share = "legs_loss.coverage(image, gt_image)"
    assert [entry["reason"].split("; write ")[1] for entry in found["left"] if "diluted" in entry["reason"]] == [
        f"(1.0 - (1.0 - fused_ssim(image[None], gt_image[None])) / {share})",
        f"lpips(image, gt_image, 1) / {share}",
    ]
    assert not any("SSIM" in entry["reason"] for entry in found["left"])  # --ssim was not asked for
    assert legs_patch("--undo", root).returncode == 0
    assert not any("diluted" in entry["reason"] for entry in json.loads(legs_patch("--json", root).stdout)["left"])


def test_a_line_that_has_to_be_written_by_hand(tmp_path):
    text = SCRIPT.replace("l1_loss(image, gt_image)", 'l1_loss(image, gt_image.to("cpu"))')
    root = checkout(tmp_path, {**FILES, "train.py": text})
    done = legs_patch("--masks", root)
    assert done.returncode == 1 and "wrote train.py" in done.stdout
    assert "not masked: the images have no names here" in done.stderr
    assert "hand: give both images names, and mask the rendering on a line of its own before every term" in done.stderr
    strict = legs_patch("--masks", "--strict", checkout(tmp_path / "strict", {**FILES, "train.py": text}))
    assert strict.returncode == 2 and "nothing was changed" in strict.stderr


def test_line_ends_and_an_edit_since(tmp_path):
    root = checkout(tmp_path, {**FILES, "train.py": SCRIPT.replace("\n", "\r\n")})
    assert legs_patch("--masks", root).returncode == 0
    data = (root / "train.py").read_bytes()
    assert data.count(b"\n") == data.count(b"\r\n") and LINE.encode().strip() in data
    (root / "train.py").write_bytes(data.replace(b"0.8", b"0.7"))
    assert legs_patch("--undo", "--force", root).returncode == 0
    assert (root / "train.py").read_bytes() == SCRIPT.replace("\n", "\r\n").replace("0.8", "0.7").encode()
