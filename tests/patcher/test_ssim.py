"""legs-patch --ssim: functions are 3DGS's SSIM by the values they compute; patched, run and taken back."""

from __future__ import annotations

import json

import pytest

pytest.importorskip("libcst")

from hypothesis import given, settings
from hypothesis import strategies as st
from legs_adapters.plan import plan
from legs_adapters.terms.structural.functions import SsimFunctions

from legs_loss.reference.embedded import write_embedded_scene
from tests.code.support import function, program
from tests.patcher.support import checkout, files, legs_patch, snapshot
from tests.patcher.test_run import python, result

SSIM = files("ssim_beside_l1_fused")["utils/loss_utils.py"]


def answer(source, name="ssim", *extras, **keywords):
    made = program(source)
    return SsimFunctions(made).answer(function(made, name), extras, keywords)


TRAIN = files("runnable_train_script_weighted")["train.py"].splitlines()
L1 = TRAIN.index("        Ll1 = l1_loss(image, gt_image)") + 1
WHERE = SSIM.splitlines().index("def ssim(img1, img2, window_size=11, size_average=True):") + 1


def scripts():
    """A script that trains on the CPU, with the SSIM of 3DGS."""
    return {**files("runnable_train_script_weighted"), "utils/loss_utils.py": SSIM}


class TestWhatIsTheSsimOf3dgs:
    def test_its_settings_are(self):
        assert answer(SSIM).is_ssim
        assert answer(SSIM, "ssim", 11, True).is_ssim
        assert answer(SSIM, "ssim", window_size=9).is_ssim is False
        assert answer(SSIM, "ssim", size_average=False).is_ssim is False

    @settings(max_examples=25, deadline=None)
    @given(
        st.sampled_from([9, 11, 13]),
        st.sampled_from([1.5, 1.5000001, 1.4]),
        st.sampled_from(["0.01 ** 2", "1e-4", "0.0001 * 1.0", "0.011 ** 2"]),
        st.sampled_from(["window_size // 2", "0", "(window_size - 1) // 2"]),
        st.booleans(),
    )
    def test_it_is_by_value_alone(self, size, sigma, c1, padding, mean):
        source = SSIM.replace("window_size=11", f"window_size={size}").replace("1.5)", f"{sigma})")
        source = source.replace("C1 = 0.01 ** 2", f"C1 = {c1}").replace(
            "padding=window_size // 2", f"padding={padding}"
        )
        source = source.replace("size_average=True", f"size_average={mean}")
        same = (size, sigma, padding != "0", mean) == (11, 1.5, True, True) and c1 != "0.011 ** 2"
        assert bool(answer(source).is_ssim) is same

    @pytest.mark.parametrize(
        "body",
        [
            "10 ** 10 ** 10",
            "sum(range(10 ** 12))",
            "[a for i in range(4000) for j in range(4000)]",
            "ssim(a, b)",
            "a.repeat(10 ** 6, 10 ** 6)",
            "torch.arange(10 ** 9)",
            "__import__('os').system('false')",
            "open('/etc/passwd').read()",
            "a.__class__",
            "(lambda: a)()",
        ],
    )
    def test_what_is_not_followed_ends_the_evaluation_there(self, body):
        found = answer(f"import torch\n\n\ndef ssim(a, b):\n    return {body}\n")
        assert found.is_ssim is None
        assert found.decider is not None

    def test_a_long_evaluation_is_ended(self):
        body = "".join(f"    x{i} = x{i - 1} * x{i - 1}\n" for i in range(1, 40))
        assert answer(f"def ssim(a, b):\n    x0 = 3\n{body}    return a * x39\n").is_ssim is None
        loops = "    for i in range(4000):\n        for j in range(4000):\n            x = i\n    return a\n"
        assert answer(f"def ssim(a, b):\n{loops}").is_ssim is None

    def test_one_that_raises_for_all_images_is_not(self):
        assert answer("def ssim(a, b):\n    raise ValueError\n").is_ssim is False


class TestPatch:
    def test_without_the_option_no_ssim_is_touched_or_listed(self, tmp_path):
        found = plan(checkout(tmp_path, files("ssim_beside_l1_fused")))
        assert not [edit for edits in found.edits.values() for edit in edits if b"ssim" in edit.after]
        assert all(site.form.weighs for site in found.findings.sites)
        assert not [left for left in found.findings.left if left.evidence.rule.startswith("ssim-")]

    def test_the_l1_terms_are_what_they_are_without_it(self, tmp_path):
        root = checkout(tmp_path, files("ssim_beside_l1_fused"))
        plain, both = plan(root), plan(root, ssim=True)
        assert [site[:4] for site in both.findings.sites if site.form.weighs] == [s[:4] for s in plain.findings.sites]
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
        assert f"patched               utils/loss_utils.py:{WHERE} is the SSIM of 3DGS\n" in done.stdout
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

    def test_a_loss_that_is_differentiated_twice_is_left(self, tmp_path):
        texts = scripts()
        texts["train.py"] = texts["train.py"].replace("loss.backward()", "loss.backward(create_graph=True)")
        left = plan(checkout(tmp_path, texts), ssim=True).findings.left
        assert "ssim-twice" in [entry.evidence.rule for entry in left]


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
