"""The drop-in l1_loss: the calls that it weights, its memory, its variables."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from legs_loss import LegsError, WeightSpec, configure, l1_loss, weight_map
from legs_loss.runtime import counts, memo, state
from tests.preloaded import run
from tests.runtime.support import pair, plain, weighted
from tests.support import legs_environment


class TestWhenItWeights:
    def test_a_prediction_that_is_trained_on(self):
        prediction, target = pair(3, 9, 8)
        loss = l1_loss(prediction, target)
        torch.testing.assert_close(loss, weighted(prediction, target))
        loss.backward()
        expected = weight_map(target) * torch.sign(prediction.detach() - target) / target.numel()
        torch.testing.assert_close(prediction.grad, expected)

    def test_not_under_no_grad_nor_without_a_gradient(self):
        prediction, target = pair(3, 9, 8)
        with torch.no_grad():
            assert torch.equal(l1_loss(prediction, target), plain(prediction, target))
        assert torch.equal(l1_loss(prediction.detach(), target), plain(prediction.detach(), target))
        # Evaluation code may hand over what is no image: the codebase's own loss took it.
        assert torch.equal(l1_loss(torch.ones(5), torch.zeros(5)), torch.tensor(1.0))
        assert (counts().weighted, counts().plain) == (0, 3)

    @pytest.mark.parametrize("variable", [("LEGS_OFF", "1"), ("LEGS_BETA", "0"), ("LEGS_PRESET", "3dgs")])
    def test_off_is_the_codebases_own_to_the_last_bit(self, monkeypatch, variable):
        monkeypatch.setenv(*variable)
        prediction, target = pair(3, 31, 17)
        loss = l1_loss(prediction, target, view="a")
        assert torch.equal(loss, plain(prediction, target))
        assert torch.equal(
            torch.autograd.grad(loss, prediction)[0], torch.autograd.grad(plain(prediction, target), prediction)[0]
        )
        assert counts().weighted == 0

    def test_the_first_weighted_step_says_what_is_active(self, capsys):
        prediction, target = pair(3, 9, 8)
        for _ in range(3):
            l1_loss(prediction, target)
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == 1
        assert "preset legs: laplacian, C3, beta 10" in lines[0]

    def test_masks_batches_and_channels_last(self):
        prediction, target = pair(2, 3, 9, 8)
        mask = torch.rand(2, 9, 8)
        expected = (weight_map(target) * mask.unsqueeze(1) * torch.abs(prediction - target)).mean()
        torch.testing.assert_close(l1_loss(prediction, target, view=["a", "b"], mask=mask), expected)
        last = l1_loss(prediction.movedim(1, -1), target.movedim(1, -1), mask=mask, channels_last=True)
        torch.testing.assert_close(last, expected)
        with torch.no_grad():
            masked = (mask.unsqueeze(1) * torch.abs(prediction - target)).mean()
            torch.testing.assert_close(l1_loss(prediction, target, mask=mask), masked)

    @pytest.mark.parametrize("channels_last", [False, True])
    def test_a_picture_beside_a_batch_of_one(self, channels_last):
        prediction, target = pair(9, 8, 3) if channels_last else pair(3, 9, 8)
        whole = l1_loss(prediction[None], target[None], channels_last=channels_last, reduction="none")
        for sides in ((prediction, target[None]), (prediction[None], target)):
            assert torch.equal(l1_loss(*sides, channels_last=channels_last, reduction="none"), whole)
            torch.testing.assert_close(l1_loss(*sides, channels_last=channels_last), whole.mean())
            own = l1_loss(*sides, channels_last=channels_last, own=lambda a, b: (a - b).abs().sum())
            torch.testing.assert_close(own, whole.sum())
            for view in ("a", ["a"], 0):  # readers that count their views name them so
                named = l1_loss(*sides, view=view, channels_last=channels_last)
                torch.testing.assert_close(named, whole.mean())
        with pytest.raises(LegsError, match="differ in shape"):
            l1_loss(prediction, torch.stack([target, target]), channels_last=channels_last)

    @pytest.mark.parametrize("channels_last", [False, True])
    def test_the_views_of_several_scenes(self, channels_last):
        prediction, target = pair(2, 3, 6, 5, 3) if channels_last else pair(2, 3, 3, 6, 5)
        one = l1_loss(prediction.flatten(0, 1), target.flatten(0, 1), channels_last=channels_last, reduction="none")
        whole = l1_loss(prediction, target, channels_last=channels_last, reduction="none")
        assert torch.equal(whole, one.reshape(target.shape))
        torch.testing.assert_close(l1_loss(prediction, target, channels_last=channels_last), whole.mean())
        mask = (torch.rand(2, 3, 6, 5) > 0.5).float()
        masked = l1_loss(prediction, target, mask=mask, channels_last=channels_last, reduction="none")
        torch.testing.assert_close(masked, whole * mask.unsqueeze(-1 if channels_last else -3))
        own = l1_loss(
            prediction, target, channels_last=channels_last, own=lambda a, b: (a - b).abs().mean((0, 2, 3, 4))
        )
        torch.testing.assert_close(own, whole.mean((0, 2, 3, 4)))

    @pytest.mark.parametrize(
        ("shapes", "options", "message"),
        [
            (((3, 9, 8), (3, 9, 7)), {}, r"\[3, 9, 8\] and target \[3, 9, 7\]"),
            (((5,), (5,)), {}, r"\[5\] is a list of pixels"),
            (((2, 3, 9, 8), (2, 3, 9, 8)), {"view": ["a"]}, r"\[2, 3, 9, 8\] holds 2, got \['a'\]"),
            (((2, 3, 9, 8), (2, 3, 9, 8)), {"view": "a"}, "one name a view"),
            (((3, 9, 8), (3, 9, 8)), {"view": 7.5}, "got 7.5"),
            (((3, 9, 8), (3, 9, 8)), {"mask": torch.ones(8, 9)}, r"mask \[8, 9\].*\[3, 9, 8\]"),
        ],
    )
    def test_what_does_not_fit_is_named(self, shapes, options, message):
        prediction, target = torch.rand(shapes[0], requires_grad=True), torch.rand(shapes[1])
        with pytest.raises(LegsError, match=message):
            l1_loss(prediction, target, **options)


class TestMemo:
    @pytest.fixture(autouse=True)
    def with_torch(self, monkeypatch):
        """Numba computes the range of a response sooner than the memo knows an image again."""
        monkeypatch.setenv("LEGS_BACKEND", "torch")

    def test_a_target_that_stays_is_computed_once(self):
        prediction, target = pair(3, 9, 8)
        for _ in range(4):
            l1_loss(prediction, target, view="a")
        assert (counts().computed, counts().remembered, counts().weighted) == (1, 3, 4)

    def test_a_views_name_is_no_proof(self):
        """mip-splatting shifts a view's target from step to step; others composite a random background."""
        prediction, target = pair(3, 9, 8)
        for i in range(3):
            shifted = torch.roll(target, i, dims=2)
            torch.testing.assert_close(l1_loss(prediction, shifted, view="a"), weighted(prediction, shifted))
        assert counts().computed == 3

    def test_each_view_of_a_batch_is_remembered_by_itself(self):
        prediction, target = pair(2, 3, 9, 8)
        first = l1_loss(prediction, target, view=["a", "b"])
        second = l1_loss(prediction.flip(0), target.flip(0), view=["b", "a"])
        torch.testing.assert_close(first, second)
        assert (counts().computed, counts().remembered) == (2, 2)

    def test_when_it_is_full_it_computes(self):
        configure("legs", memo_bytes=9 * 8 * 4 + 1024)
        targets = [torch.rand(3, 9, 8) for _ in range(3)]
        prediction = torch.rand(3, 9, 8, requires_grad=True)
        for target in targets + targets:
            torch.testing.assert_close(l1_loss(prediction, target), weighted(prediction, target))
        assert state.current_run().memo.bytes <= 9 * 8 * 4 + 1024

    @pytest.mark.parametrize("by", ["content", "identity"])
    def test_any_order_of_changing_targets_gets_its_own_weight(self, monkeypatch, by):
        if by == "identity":
            monkeypatch.setattr(memo, "_key", memo._identity_key)
        generator = torch.Generator().manual_seed(5)
        stored = [torch.rand(4, 6, 7) for _ in range(3)]
        prediction = torch.rand(3, 6, 7, requires_grad=True)
        for _ in range(200):
            index, what = torch.randint(0, 3, (1,), generator=generator).item(), torch.rand(1, generator=generator)
            if what < 0.1:
                stored[index].mul_(0.9)
            elif what < 0.2:
                stored[index] = torch.rand(4, 6, 7)
            target = stored[index][:3]
            target = target.clone() if 0.2 <= what < 0.4 else target
            torch.testing.assert_close(l1_loss(prediction, target, view=str(index)), weighted(prediction, target))
        assert counts().remembered > 50


def test_the_one_line_import_costs_nothing_but_torch():
    script = (
        "import sys, torch; before = set(sys.modules); from legs_loss import l1_loss; "
        "new = {m.split('.')[0] for m in set(sys.modules) - before}; "
        "heavy = new & {'numba', 'kornia', 'matplotlib', 'PIL', 'scipy', 'tqdm'}; "
        "sys.exit(', '.join(heavy) or None)"
    )
    root = str(Path(__file__).resolve().parents[2])
    result = subprocess.run(
        [sys.executable, "-c", script], env=dict(os.environ, PYTHONPATH=root), capture_output=True, text=True
    )
    assert result.returncode == 0, result.stderr


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(torch, "compile"), reason="this torch has no torch.compile")
def test_it_can_be_compiled():
    compiled = torch.compile(lambda p, t: l1_loss(p, t))
    prediction, target = pair(3, 16, 16)
    torch.testing.assert_close(compiled(prediction, target), weighted(prediction, target))


@pytest.mark.skipif(not hasattr(torch, "compile"), reason="this torch has no torch.compile")
def test_its_graph_is_whole_from_the_first_call(monkeypatch):
    monkeypatch.setenv("LEGS_BETA", "4")
    compiled = torch.compile(lambda p, t: l1_loss(p, t), fullgraph=True, backend="aot_eager")
    prediction, target = pair(3, 16, 16)
    torch.testing.assert_close(compiled(prediction, target), weighted(prediction, target, WeightSpec(beta=4.0)))
    configure("legs-l")
    torch.testing.assert_close(compiled(prediction, target), weighted(prediction, target, "legs-l"))
    with torch.no_grad():
        assert torch.equal(compiled(prediction, target), plain(prediction, target))


class TestScripts:
    """A training script in a process of its own, with settings in its environment."""

    SCRIPT = """
import torch
from legs_loss import l1_loss
image, target = torch.linspace(0, 1, 192, requires_grad=True).reshape(3, 8, 8), torch.ones(3, 8, 8) * 0.25
target[:, 4:] = 0.75
print(bool(l1_loss(image, target) > (image - target).abs().mean() + 1e-3))
"""

    def run(self, tmp_path, **variables):
        (tmp_path / "train.py").write_text(self.SCRIPT)
        environment = {name: value for name, value in legs_environment().items() if not name.startswith("LEGS_")}
        environment.update(variables, LEGS_BACKEND="torch")
        command = [sys.executable, str(tmp_path / "train.py")]
        return run(command, env=environment)

    @pytest.mark.parametrize(("value", "weighted"), [("false", True), ("no", True), ("yes", False), ("1", False)])
    def test_legs_off(self, tmp_path, value, weighted):
        done = self.run(tmp_path, LEGS_OFF=value)
        assert (done.returncode, done.stdout.strip()) == (0, str(weighted)), done.stderr

    def test_a_mistyped_variable_is_told(self, tmp_path):
        done = self.run(tmp_path, LEGS_BETAA="0")
        assert done.stdout.strip() == "True"
        assert "LEGS_BETAA is not known and has no effect; did you mean 'LEGS_BETA'?" in done.stderr

    @pytest.mark.parametrize(
        "variables", [{"LEGS_PRESET": "legz"}, {"LEGS_BETA": "1e300"}, {"LEGS_BETA": "nan"}, {"LEGS_OFF": "maybe"}]
    )
    def test_a_bad_variable_ends_the_script_with_its_name(self, tmp_path, variables):
        done = self.run(tmp_path, **variables)
        assert done.returncode == 1
        assert f"LegsError: environment variable {next(iter(variables))}" in done.stderr.splitlines()[-1]
