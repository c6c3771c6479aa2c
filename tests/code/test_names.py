"""Names and operations: the meanings of words, the effects of torch's operations, and that each list stands once."""

from __future__ import annotations

import ast
from pathlib import Path

import legs_adapters
import pytest
import torch
from legs_adapters.lexicon import words
from legs_adapters.lexicon.names import is_l1_name, kind_of_words, role_of_words
from legs_adapters.tensors import operations

ROOT = Path(legs_adapters.__file__).parent

KINDS = {
    "gt_image": "image",
    "renderedImages": "image",
    "render_pkg": "image",
    "depth_image": "depth",
    "invdepthmap": None,  # one word, which the lists do not know
    "invdepth": "depth",
    "normal_map": "normal",
    "optical_flow": "flow",
    "image_features": "feature",
    "warped_image": "warp",
    "image_gradient": "gradient",
    "alpha_mask": "mask",
    "image_mask": "mask",  # laid over an image
    "scaling": "parameter",
    "radii": "parameter",
    "target_volume": "feature",
    "colors_precomp": "parameter",  # a colour for each Gaussian
    "image_no_sh": "image",
    "sky_rgb": "image",
    "offset_image": "parameter",
    "image_offset": "parameter",
    "left_image": "image",
    "iteration": None,
}


@pytest.mark.parametrize("name", KINDS)
def test_the_kind_of_picture_that_a_name_speaks_of(name):
    assert kind_of_words(name) == KINDS[name]


ROLES = {
    "gt_image": "target",
    "original_image": "target",
    "rendered": "render",
    "pred_rgb": "render",
    "rendered_gt": None,  # only a closer look can tell
    "image": None,
}


@pytest.mark.parametrize("name", ROLES)
def test_the_role_that_a_name_speaks_of(name):
    assert role_of_words(name) == ROLES[name]


@pytest.mark.parametrize("name", ["l1_loss", "L1", "l1", "masked_l1_loss", "l1_loss_mask", "weighted_l1", "l1_loss_v2"])
def test_a_name_of_an_l1_function(name):
    assert is_l1_name(name)


@pytest.mark.parametrize("name", ["l2_loss", "smooth_l1_loss", "ssim", "l1_ratio", "loss"])
def test_a_name_of_another_function(name):
    assert not is_l1_name(name)


# An operation, as it is called on a [2, 3, 4] tensor of values in range.
CALLS = {
    "clamp": lambda x: x.clamp(0, 1), "clamp_": lambda x: x.clone().clamp_(0, 1), "clamp_max": lambda x: x.clamp_max(1),
    "clamp_min": lambda x: x.clamp_min(0), "clip": lambda x: x.clip(0, 1), "nan_to_num": lambda x: x.nan_to_num(),
    "clone": lambda x: x.clone(), "contiguous": lambda x: x.contiguous(), "cpu": lambda x: x.cpu(),
    "detach": lambda x: x.detach(), "double": lambda x: x.double(), "float": lambda x: x.float(),
    "to": lambda x: x.to(torch.float64), "type": lambda x: x.type(torch.float64), "type_as": lambda x: x.type_as(x),
    "flatten": lambda x: x.flatten(), "flip": lambda x: x.flip(0), "movedim": lambda x: x.movedim(0, 2),
    "permute": lambda x: x.permute(2, 0, 1), "reshape": lambda x: x.reshape(6, 4), "roll": lambda x: x.roll(1),
    "rot90": lambda x: x.rot90(), "squeeze": lambda x: x.squeeze(), "transpose": lambda x: x.transpose(0, 1),
    "unsqueeze": lambda x: x.unsqueeze(0), "view": lambda x: x.view(6, 4), "view_as": lambda x: x.view_as(x),
    "expand_as": lambda x: x.expand_as(x), "reshape_as": lambda x: x.reshape_as(x),
    "cat": lambda x: torch.cat([x]), "stack": lambda x: torch.stack([x]), "as_tensor": torch.as_tensor,
}  # fmt: skip


@pytest.mark.parametrize("name", CALLS)
def test_an_operation_that_keeps_values_does(name):
    assert name in operations.PICTURE_FUNCTIONS | operations.JOINS
    values = torch.rand(2, 3, 4, generator=torch.Generator().manual_seed(0))
    done = CALLS[name](values).float()
    assert torch.equal(done.flatten().sort().values, values.flatten().sort().values)
    if name in operations.KEEPS_AXES:
        assert torch.equal(done, values)


@pytest.mark.parametrize("name", sorted(operations.ENDS_GRADIENT - {"numpy"}))
def test_no_gradient_comes_back_through_an_operation_that_ends_it(name):
    done = getattr(torch.ones(1, requires_grad=True), name)()
    assert not getattr(done, "requires_grad", False)


@pytest.mark.parametrize("name", sorted(operations.TRANSFORMS))
def test_an_absolute_value_is_none_any_more_after_a_transform(name):
    values = torch.tensor([0.3, 0.6])
    others = {"pow": 2, "maximum": torch.tensor(0.4), "minimum": torch.tensor(0.4)}
    done = getattr(torch, name)(values, *([others[name]] if name in others else []))
    assert not torch.allclose(done[1] / done[0], torch.tensor(2.0), rtol=1e-3)


def lists(path):
    """Return the names of the lists of words and sets of strings that a module keeps."""
    found = []
    for statement in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(statement, ast.Assign) and isinstance(statement.targets[0], ast.Name):
            value = statement.value
            made = getattr(value.func, "id", "") if isinstance(value, ast.Call) else ""
            texts = isinstance(value, ast.Set) and not any(isinstance(e, ast.Tuple) for e in value.elts)
            if texts or made in ("word_set", "frozenset", "set"):
                found.append(statement.targets[0].id)
    return found


LAYERS = ("tensors", "lexicon", "terms", "rules", "upstreams")
FILES = [path for layer in LAYERS for path in sorted((ROOT / layer).rglob("*.py"))]


@pytest.mark.parametrize(
    "path",
    [path for path in FILES if path.name not in ("words.py", "operations.py")],
    ids=lambda path: f"{path.parent.name}/{path.name}",
)
def test_words_and_operations_stand_in_their_two_files(path):
    assert lists(path) == []


def test_every_list_of_words_is_used():
    texts = [path.read_text(encoding="utf-8") for path in ROOT.rglob("*.py") if path.name != "words.py"]
    texts.append((ROOT / "lexicon/words.py").read_text(encoding="utf-8").split("KINDS = tuple", 1)[1])
    own = [name for name in vars(words) if name.isupper()]
    unused = [name for name in own if sum(text.count(name) for text in texts) - texts[-1].count(f"\n{name} =") < 1]
    assert unused == []
