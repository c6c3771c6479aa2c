"""legs-patch --ssim: functions are 3DGS's SSIM by the form of their code; patched, run and taken back."""

from __future__ import annotations

import json

import pytest
from legs_adapters.plan import plan
from legs_adapters.terms.ssim import FORMS, form_of

from legs_loss.lab.embedded import write_embedded_scene
from tests.code.support import function, program
from tests.patcher.support import checkout, files, legs_patch, snapshot
from tests.patcher.test_run import python, result

SSIM = files("ssim_beside_l1_fused")["utils/loss_utils.py"]


def form(source):
    made = program(source)
    return form_of(made, function(made, "ssim"))


TRAIN = files("runnable_train_script_weighted")["train.py"].splitlines()
L1 = TRAIN.index("        Ll1 = l1_loss(image, gt_image)") + 1
WHERE = SSIM.splitlines().index("def ssim(img1, img2, window_size=11, size_average=True):") + 1


def scripts():
    """A script that trains on the CPU, with the SSIM of 3DGS."""
    return {**files("runnable_train_script_weighted"), "utils/loss_utils.py": SSIM}


CHANGES = [
    ("gaussian(window_size, 1.5)", "gaussian(window_size, 1.4)"),
    ("gaussian(window_size, 1.5)", "gaussian(window_size, 1.5000001)"),
    ("window_size=11", "window_size=9"),
    ("size_average=True):\n    channel", "size_average=False):\n    channel"),
    ("0.01 ** 2", "0.011 ** 2"),
    ("0.03 ** 2", "0.03 ** 3"),
    ("img1, window, padding=window_size // 2", "img1, window, padding=0"),
    ("img2 * img2, window, padding=window_size // 2", "img2 * img2, window, padding=window_size // 3"),
    ("float(2 * sigma", "float(3 * sigma"),
    ("x - window_size // 2)", "x - window_size // 2 - 1)"),
    ("2 * cov + C2", "2 * cov + C1"),
    ("size_average=True):\n    mu1", "size_average=False):\n    mu1"),
    ("channel, size_average)\n", "channel)\n"),
    ("window_size, channel, size_average)\n", "window_size, size_average, channel)\n"),
    ("return ssim_map.mean()", "return ssim_map.sum()"),
    ("var1 = F.conv2d(img1 * img1", "var1 = F.conv2d(img1 * img2"),
    ("from math import exp", "from numpy import exp"),
    ("from math import exp", "from utils.more import exp"),
    ("import torch.nn.functional as F", "import utils.functional as F"),
    ("def ssim(", "@torch.no_grad()\ndef ssim("),
    ("    C1 = 0.01 ** 2\n", ""),
    ("(window_size, sigma):", "(window_size: int, sigma: float) -> torch.Tensor:"),  # what it is called by is not known
]
SAME = [
    ("mu1", "mean_of_first"),
    ("img1", "prediction"),
    ("taps", "row"),
    ("_ssim(", "similarity("),
    ("create_window", "window_of"),
    ("    channel = img1", '    """The mean SSIM."""\n    # of each channel\n    channel = img1'),
    ("F.conv2d(", "torch.nn.functional.conv2d("),
    ("taps.sum()", "taps . sum( )"),
]


def test_the_form_of_the_test_script_is_in_the_table():
    assert form(SSIM) in FORMS
    assert all(len(name) == 16 and int(name, 16) for name in FORMS)


@pytest.mark.parametrize(("old", "new"), CHANGES)
def test_any_other_constant_default_argument_or_operation_is_another_form(old, new):
    assert old in SSIM
    assert form(SSIM.replace(old, new, 1)) not in FORMS


@pytest.mark.parametrize(("old", "new"), SAME)
def test_names_comments_spaces_and_docstrings_are_not_in_the_form(old, new):
    assert old in SSIM
    assert form(SSIM.replace(old, new)) == form(SSIM)


def test_a_keyword_of_the_checkouts_own_function_has_no_form_and_one_of_torchs_is_kept():
    by_keyword = SSIM.replace("channel, size_average)\n", "channel=channel, size_average=size_average)\n")
    assert by_keyword != SSIM and form(by_keyword) is None
    stride = "def ssim(a, padding, stride):\n    return torch.nn.functional.conv2d(a, a, {}={})\n"
    made = {form("import torch\n" + stride.format(*names)) for names in (("padding", "padding"), ("stride", "padding"))}
    assert len(made) == 2 and None not in made


@pytest.mark.parametrize(
    "body",
    ["scale * a", "unknown(a, b)", "[C1 for C1 in a][C2]", "other_package_or_not.ssim(a, b)"],
)
def test_a_function_with_a_name_of_unknown_value_has_no_form(body):
    assert form(f"scale = 1.0\n\n\ndef ssim(a, b):\n    return {body}\n") is None


def test_a_function_that_calls_itself_and_one_of_many_functions_end():
    assert form("def ssim(a, b):\n    return ssim(a, b)\n")
    many = "".join(f"def f{i}(a, b):\n    return f{i + 1}(a, b)\n\n\n" for i in range(40))
    assert form(f"{many}def ssim(a, b):\n    return f0(a, b)\n") is None


class TestPatch:
    def test_without_the_option_no_ssim_is_touched_or_listed(self, tmp_path):
        found = plan(checkout(tmp_path, files("ssim_beside_l1_fused")))
        assert not [edit for edits in found.edits.values() for edit in edits if b"ssim" in edit.after]
        assert not any(site.form.term for site in found.findings.sites)
        assert not [left for left in found.findings.left if left.rule.startswith("ssim-")]

    def test_the_l1_terms_are_what_they_are_without_it(self, tmp_path):
        root = checkout(tmp_path, files("ssim_beside_l1_fused"))
        plain, both = plan(root), plan(root, ssim=True)
        assert [site[:4] for site in both.findings.sites if not site.form.term] == [s[:4] for s in plain.findings.sites]
        assert {left[:4] for left in plain.findings.left} <= {left[:4] for left in both.findings.left}
        assert set(plain.edits["train.py"]) <= set(both.edits["train.py"])

    def test_checked_shown_patched_twice_and_taken_back(self, tmp_path):
        root = checkout(tmp_path, scripts(), git=True)
        before = snapshot(root)
        assert legs_patch("--check", "--ssim", root).returncode == 1
        shown = legs_patch("--diff", "--ssim", root).stdout
        assert "+        loss = 0.8 * Ll1 + 0.2 * (1.0 - legs_loss.ssim(image, gt_image))\n" in shown
        done = legs_patch("--ssim", root)
        assert done.returncode == 0, done.stderr
        assert f"patched  utils/loss_utils.py:{WHERE} is the SSIM of 3DGS\n" in done.stdout
        again = legs_patch("--ssim", "--check", root)
        assert again.returncode == 0
        assert again.stdout.count("already patched") == 2
        assert legs_patch("--check", root).returncode == 0
        assert legs_patch("--undo", root).returncode == 0
        assert snapshot(root) == before

    def test_added_to_a_patch_of_the_l1_alone(self, tmp_path):
        root = checkout(tmp_path, scripts())
        before = snapshot(root)
        assert legs_patch(root).returncode == 0
        assert legs_patch("--check", "--ssim", root).returncode == 1
        assert legs_patch("--ssim", root).returncode == 0
        lines = [line for line in (root / "train.py").read_text().splitlines() if "# weighted" not in line]
        text = "\n".join(lines)
        assert (
            text.count("legs_loss.l1_loss(") == text.count("legs_loss.ssim(") == text.count("import legs_loss\n") == 1
        )
        assert legs_patch("--undo", root).returncode == 0
        assert snapshot(root) == before

    def test_its_entries_in_json_say_so(self, tmp_path):
        found = json.loads(legs_patch("--check", "--ssim", "--json", checkout(tmp_path, scripts())).stdout)
        assert [(site["line"], site.get("term")) for site in found["sites"]] == [(L1, None), (L1 + 1, "ssim")]

    def test_a_site_by_hand_is_the_ssim_or_the_l1_alone(self, tmp_path):
        root = checkout(tmp_path, scripts())
        found = plan(root, by_hand=[("train.py", L1 + 1)], ssim=True).findings
        assert [site.line for site in found.sites] == [L1 + 1]
        assert [site.line for site in plan(root, by_hand=[("train.py", L1)], ssim=True).findings.sites] == [L1]

    def test_without_an_l1_term_it_does_nothing(self, tmp_path):
        texts = scripts()
        texts["train.py"] = texts["train.py"].replace("l1_loss(image, gt_image)", "(image - gt_image).square().mean()")
        done = legs_patch("--ssim", checkout(tmp_path, texts))
        assert done.returncode == 2
        assert "no photometric L1 term was found" in done.stderr


@pytest.mark.slow
def test_in_memory_the_losses_are_those_of_the_l1_alone(tmp_path):
    pytest.importorskip("numba")
    scene = write_embedded_scene(tmp_path / "scene", views=2, width=40, height=30, points=100, samples=1)
    root = checkout(tmp_path / "checkout", scripts())
    before = snapshot(root)

    def losses(*options, **environment):
        train = ("train.py", "-s", scene, "--iterations", 3, "--points", 50)
        done = python("-m", "legs_loss", "run", *options, *train, cwd=root, **environment)
        return [float.fromhex(loss) for loss in result(done)["losses"]], done.stderr

    alone, _ = losses()
    both, said = losses("--ssim")
    assert f"train.py:{L1 + 1} is computed by legs_loss.ssim in this run" in said
    assert both == pytest.approx(alone, rel=1e-3)
    assert both[0] == pytest.approx(alone[0], rel=1e-5)
    assert losses("--ssim", LEGS_OFF="1")[0] == losses(LEGS_OFF="1")[0]
    assert snapshot(root) == before
