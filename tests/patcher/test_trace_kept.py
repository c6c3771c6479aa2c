"""legs-patch --trace on scripts whose loss the text does not show; of each what is weighted was written down first."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from PIL import Image

from tests.patcher.support import legs_patch
from tests.patcher.traced import write, write_scene

pytestmark = pytest.mark.slow

STEP = """
    loss.backward()
    splats.optimizer.step()
    splats.optimizer.zero_grad()
"""
LOOP = """
for step in range(200):
    camera = views[step % len(views)]
    gt_image, drawn = camera.values["images"], splats.draw(camera)
"""
# A body of train.py; "<- here" stands at each line that is weighted, "<- quoted" at one that is an error, "<- may be
# quoted" at one that is an error or skipped.
SCRIPTS = {
    "losses made by a factory, from settings": """
def absolute(scale):
    return lambda a, b: scale * torch.mean(torch.abs(a - b))  # <- here


settings = {"rgb": ["absolute", 0.8], "depth": ["F.mse_loss", 0.1]}
criteria = {key: absolute(scale) if name == "absolute" else F.mse_loss for key, (name, scale) in settings.items()}
LOOP
    targets = {"rgb": gt_image, "depth": gt_image[:1]}
    loss = sum(criteria[key](drawn[key], targets[key]) for key in settings)
STEP
""",
    "one function for colour and normals, called twice": """
def compare(output, reference):
    return (output - reference).abs().mean()


LOOP
    loss = compare(drawn["rgb"], gt_image)  # <- here
    loss = loss + 0.05 * compare(drawn["normal"], camera.values["normals"])
STEP
""",
    "one loop for colour and normals": """
LOOP
    loss = 0.0
    for key, target in (("rgb", gt_image), ("normal", camera.values["normals"])):
        loss = loss + (drawn[key] - target).abs().mean()  # <- quoted
STEP
""",
    "a sharp teacher beside the photograph": """
class Teacher:
    def draw(self, camera):
        with torch.no_grad():
            image = camera.values["images"][None]
            soft = image
            for _ in range(3):
                soft = F.avg_pool2d(F.pad(soft, (1, 1, 1, 1), mode="replicate"), 3, 1)
            floaters = 0.05 * torch.sin(1.3 * torch.arange(image.shape[-1]))
            return (0.5 * image + 0.5 * soft + floaters)[0]


teacher = Teacher()
LOOP
    loss = 0.8 * F.l1_loss(drawn["rgb"], gt_image)  # <- here
    pseudo = teacher.draw(camera)
    loss = loss + 0.2 * F.l1_loss(drawn["rgb"], pseudo)  # <- may be quoted
STEP
""",
    "a grey copy of the photograph": """
LOOP
    loss = F.l1_loss(drawn["rgb"], gt_image)  # <- here
    grey = gt_image.mean(0, keepdim=True).expand(3, -1, -1)
    loss = loss + 0.1 * F.l1_loss(drawn["rgb"].mean(0, keepdim=True).expand(3, -1, -1), grey)  # <- may be quoted
STEP
""",
    "patches that are cut out": """
LOOP
    y, x = step % 9, (3 * step) % 17
    patch = gt_image[:, y : y + 20, x : x + 28]
    loss = F.l1_loss(drawn["rgb"][:, y : y + 20, x : x + 28], patch)  # <- here
STEP
""",
    "patches of a batch beside normals": """
LOOP
    batch = torch.stack([gt_image, camera.values["normals"]])
    y, x = step % 9, (3 * step) % 17
    loss = F.l1_loss(drawn["rgb"][:, y : y + 20, x : x + 28], batch[0, :, y : y + 20, x : x + 28])  # <- here
    other = batch[1, :, y : y + 20, x : x + 28]
    loss = loss + 0.1 * F.l1_loss(drawn["normal"][:, y : y + 20, x : x + 28], other)
STEP
""",
    "a line that is the photograph's in every second step": """
LOOP
    target = gt_image if step % 2 else torch.rand_like(gt_image)
    loss = F.l1_loss(drawn["rgb"], target)  # <- quoted
STEP
""",
    "features of three channels, later": """
net = torch.nn.Sequential(torch.nn.Conv2d(3, 8, 3), torch.nn.ReLU(), torch.nn.Conv2d(8, 3, 3))
LOOP
    loss = (drawn["rgb"] - gt_image).abs().mean()  # <- here
    if step > 4:
        with torch.no_grad():
            target = net(gt_image[None])
        loss = loss + 0.1 * torch.nn.L1Loss()(net(drawn["rgb"][None]), target)  # <- may be quoted
STEP
""",
    "exposures alone, then the Gaussians": """
exposures = torch.nn.Parameter(torch.eye(3, 4).repeat(len(views), 1, 1))
tuner = torch.optim.Adam([exposures], lr=1e-3)
LOOP
    number = step % len(views)
    if step < 12:
        image = torch.einsum("ij,jhw->ihw", exposures[number, :, :3], drawn["rgb"].detach())
        fit = (image + exposures[number, :, 3, None, None] - gt_image).abs().mean()
        fit.backward()
        tuner.step()
        tuner.zero_grad()
        continue
    loss = F.l1_loss(drawn["rgb"], gt_image)  # <- here
STEP
""",
    "poses alone, to the end": """
moves = torch.optim.Adam([view.pose for view in views], lr=1e-3)
for leaf in (splats.xy, splats.colour, splats.opacity):
    leaf.requires_grad_(False)
LOOP
    loss = F.l1_loss(drawn["rgb"], gt_image)
    loss.backward()
    moves.step()
    moves.zero_grad()
""",
    "photographs of an array file, normals as pictures": """
import numpy

arrays = torch.from_numpy(numpy.load(os.path.join(given.s, "photographs.npy")))
LOOP
    gt_image = arrays[step % len(views)].clone()
    loss = F.l1_loss(drawn["rgb"], gt_image)  # <- quoted
    loss = loss + 0.1 * F.l1_loss(drawn["normal"], camera.values["normals"])
STEP
""",
    "a gradient that is only read, beside one that is applied": """
importance = torch.zeros_like(splats.opacity)
leaves = [splats.xy, splats.colour, splats.opacity]
LOOP
    (slope,) = torch.autograd.grad(F.l1_loss(drawn["rgb"], gt_image), [splats.opacity])  # <- quoted
    importance += slope.abs()
    loss = F.l1_loss(splats.draw(camera)["rgb"], gt_image)  # <- here
    for leaf, slope in zip(leaves, torch.autograd.grad(loss, leaves)):
        leaf.grad = slope
    splats.optimizer.step()
""",
    "one L1 function for colour and a grey copy": """
def l1_loss(output, reference):
    return torch.abs(output - reference).mean()


def brightness(picture):
    return picture[:1] + picture[1:2] + picture[2:]


LOOP
    loss = l1_loss(drawn["rgb"], gt_image)  # <- here
    loss = loss + 0.1 * l1_loss(brightness(drawn["rgb"]), brightness(gt_image))
STEP
""",
    "a difference that has a name": """
def masked(drawn, target):
    delta = drawn["rgb"] - target
    return 0.8 * delta.abs().mean()  # <- quoted


LOOP
    loss = masked(drawn, gt_image)
STEP
""",
    "photographs of an HDF5 file": """
import h5py

with h5py.File(os.path.join(given.s, "photographs.h5"), "r") as file:
    photographs = [torch.from_numpy(each) for each in file["images"][:]]
LOOP
    gt_image = photographs[step % len(views)]
    loss = (drawn["rgb"] - gt_image).abs().mean()  # <- quoted
STEP
""",
    "photographs of a film": """
import numpy
from PIL import Image, ImageSequence

with Image.open(os.path.join(given.s, "film.gif")) as film:
    frames = [torch.from_numpy(numpy.array(each.convert("RGB"))) / 255.0 for each in ImageSequence.Iterator(film)]
LOOP
    gt_image = frames[step % len(views)].permute(2, 0, 1)
    loss = F.l1_loss(drawn["rgb"], gt_image)  # <- quoted
STEP
""",
    "a teacher's rendering alone": """
teacher = Splats(90)
LOOP
    with torch.no_grad():
        gt_image = teacher.draw(camera)["rgb"]
    loss = F.l1_loss(drawn["rgb"], gt_image)  # <- quoted
STEP
""",
    "two captures, one of which has a model": """
others = cameras(given.also)
LOOP
    loss = F.l1_loss(drawn["rgb"], gt_image)  # <- here
    other = others[step % len(others)]
    seen = splats.draw(other)
    loss = loss + (seen["rgb"] - other.values["images"]).abs().mean()  # <- here
    loss = loss + 0.1 * F.l1_loss(seen["normal"], other.values["normals"])
STEP
""",
}


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """Return two captures: one with transforms.json, an array and a film of its photographs, one without."""
    folder = tmp_path_factory.mktemp("scenes")
    first, second = write_scene(folder / "first"), write_scene(folder / "second")
    files = sorted((first / "images").iterdir())
    photographs = np.stack([np.asarray(Image.open(file)) for file in files]).transpose(0, 3, 1, 2) / 255
    np.save(first / "photographs.npy", photographs.astype(np.float32))
    frames = [Image.open(file) for file in files]
    frames[0].save(first / "film.gif", save_all=True, append_images=frames[1:])
    for file in sorted((second / "images").iterdir()):
        Image.open(file).transpose(Image.ROTATE_180).save(file)
    (second / "transforms.json").unlink()
    return first, second


@pytest.mark.parametrize("name", sorted(SCRIPTS))
def test_what_was_written_down_is_weighted_and_quoted(tmp_path, scenes, name):
    first, second = scenes
    if name.startswith("photographs of"):
        first = shutil.copytree(first, tmp_path / "scene")
        if "HDF5" in name:
            with pytest.importorskip("h5py").File(first / "photographs.h5", "w") as file:
                file["images"] = np.load(first / "photographs.npy")
        for file in (first / "images").iterdir():  # for the sizes alone
            Image.new("RGB", Image.open(file).size).save(file)
    text = SCRIPTS[name].replace("\nLOOP\n", LOOP).replace("\nSTEP\n", STEP)
    head = '\nimport os\n\nparser.add_argument("--also")\ngiven = parser.parse_args()\n'
    write(tmp_path / "code", head + text)
    lines = (tmp_path / "code/train.py").read_text(encoding="utf-8").splitlines()

    def marked(what):
        return {at for at, line in enumerate(lines, 1) if f"# <- {what}" in line}

    also = f" --also {second}" if "two captures" in name else ""
    done = legs_patch("--trace", f"train.py -s {first}{also}", "--json", "--check", "--steps", "9", tmp_path / "code")
    assert done.stdout, done.stderr
    report = json.loads(done.stdout)
    weighted, quoted = ({entry["line"] for entry in report[what]} for what in ("sites", "problems"))
    assert weighted == marked("here"), done.stderr
    assert marked("quoted") <= quoted <= marked("quoted") | marked("may be quoted"), done.stderr
