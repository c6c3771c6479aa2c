"""legs-patch --trace on shapes that were met in public codebases: the lines that must be weighted, and no other."""

from __future__ import annotations

import json

import pytest

from tests.patcher.support import legs_patch
from tests.patcher.traced import write, write_scene

pytestmark = pytest.mark.slow

HEAD = """
def l1_loss(network_output, gt, mask=None):
    if mask is None:
        return torch.abs(network_output - gt).mean()
    return (torch.abs(network_output - gt) * mask).sum() / mask.sum()


for step in range(100):
    camera = views[step % len(views)]
    gt_image = camera.values["images"]
    drawn = splats.draw(camera)
    image = drawn["rgb"]
"""
END = """
    loss.backward()
    splats.optimizer.step()
    splats.optimizer.zero_grad()
"""

# A codebase, and the lines of its step; "<- here" stands at each that must be weighted.
SHAPES = {
    "gaussian_blending: the same line for pictures smaller than a thumbnail": """
        size = (32 // 2 ** (step % 3), 48 // 2 ** (step % 3))
        image, gt_image = (F.interpolate(x[None], size=size, mode="area")[0] for x in (image, gt_image))
        loss = l1_loss(image, gt_image)  # <- here
    """,
    "4DGaussians: pictures gathered in lists of a batch": """
        images, gt_images = [image.unsqueeze(0)], [gt_image.unsqueeze(0)]
        image_tensor, gt_image_tensor = torch.cat(images, 0), torch.cat(gt_images, 0)
        loss = l1_loss(image_tensor, gt_image_tensor[:, :3, :, :])  # <- here
    """,
    "DiGS: both under a mask, which is handed over as well": """
        mask = torch.ones(1, 1, *image.shape[1:])
        mask[..., :6] = 0
        loss = l1_loss(image[None] * mask, gt_image[None] * mask, mask.expand(1, 3, -1, -1))  # <- here
    """,
    "2DGS: differences of what is trained, beside it": """
        depth = drawn["depth"]
        Ll1 = l1_loss(image, gt_image)  # <- here
        dx, dy = depth[:, 2:] - depth[:, :-2], depth[:, :, 2:] - depth[:, :, :-2]
        loss = 0.8 * Ll1 + 0.1 * (dx.abs().mean() + dy.abs().mean())
    """,
    "R3GW: a rendering that must be black where there is sky": """
        sky = torch.zeros(1, *image.shape[1:])
        sky[:, :8] = 1
        loss = l1_loss(image, gt_image)  # <- here
        loss = loss + 0.1 * l1_loss(drawn["normal"], torch.zeros_like(image), sky)
    """,
    "LoDGaussianHead: two renderings of one photograph": """
        full_image = 0.5 * image + 0.5 * drawn["normal"]
        loss = 0.5 * l1_loss(full_image, gt_image)  # <- here
        loss = loss + 0.5 * l1_loss(image, gt_image)  # <- here
    """,
    "GaussianAvatars: a dictionary of losses, with factors": """
        losses = {}
        losses["l1"] = l1_loss(image, gt_image) * 0.8  # <- here
        losses["xy"] = F.relu(splats.xy - 0.9).mean()
        losses["total"] = sum(losses.values())
        loss = losses["total"]
    """,
    "VGGS: with the appearance of a view or without, by what came out": """
        if step % 2:
            loss = l1_loss(image * 1.1, gt_image)  # <- here
        else:
            loss = l1_loss(image, gt_image)  # <- here
    """,
    "Dream2DGS: what is drawn outside of an object, and a similarity, beside it": """
        outside = (gt_image.mean(0, keepdim=True) < 0.3).float()
        loss = (1.0 - 0.2) * l1_loss(image, gt_image)  # <- here
        loss = loss + 0.2 * (image - gt_image).square().mean()
        loss = loss + 0.1 * (drawn["depth"] * outside).mean()
    """,
    "FreeGave: near pixels by a depth of the view": """
        near = drawn["depth"].detach() < 0.6
        loss = l1_loss(image * near, gt_image * near)  # <- here
    """,
}


@pytest.mark.parametrize("name", sorted(SHAPES))
def test_the_photographs_lines_and_no_other(tmp_path, name):
    step = SHAPES[name].replace("\n        ", "\n    ").rstrip()
    write(tmp_path / "code", HEAD + step + END)
    text = (tmp_path / "code/train.py").read_text(encoding="utf-8").splitlines()
    expected = [("train.py", number) for number, line in enumerate(text, 1) if "# <- here" in line]
    command = f"train.py -s {write_scene(tmp_path / 'scene')}"
    done = legs_patch("--trace", command, "--json", "--check", "--steps", "9", tmp_path / "code")
    report = json.loads(done.stdout)
    assert [(site["file"], site["line"]) for site in report["sites"]] == expected, done.stderr
    assert any(term["is_photometric"] for term in report["traced"])


def test_a_term_in_a_submodule_is_named_with_what_ran(tmp_path):
    """PhysGaussian: the script of a codebase that is a submodule, whose files are not searched."""
    step = "    loss = torch.abs(image - gt_image).mean()\n"
    write(tmp_path / "code", HEAD + step + END)
    inner = tmp_path / "code/third_party/splatting"
    inner.parent.mkdir()
    inner.mkdir()
    for file in list((tmp_path / "code").glob("*.py")):
        file.rename(inner / file.name)
    command = f"third_party/splatting/train.py -s {write_scene(tmp_path / 'scene')}"
    done = legs_patch("--trace", command, "--json", "--check", "--steps", "4", tmp_path / "code")
    assert "Traceback" not in done.stderr
    report = json.loads(done.stdout)
    assert report["sites"] == [] and [p["file"] for p in report["problems"]] == ["third_party/splatting/train.py"]
