"""The drop-in l1_loss: when it weights, where the weight comes from, and that it never uses another target's."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from legs_loss import LegsError, WeightSpec, configure, l1_loss, weight_map
from legs_loss.kernels.backends import is_capturing
from legs_loss.precompute import precompute
from legs_loss.runtime import counts, memo, sources, state
from legs_loss.scenes import read_scene
from legs_loss.weights import error_weight_map
from tests.support import legs_environment


@pytest.fixture(autouse=True)
def fresh(monkeypatch, tmp_path):
    """Each test is a run of its own, started in an empty folder."""
    for name in [name for name in os.environ if name.startswith("LEGS_")]:
        monkeypatch.delenv(name)
    state.reset()
    monkeypatch.setattr(sys, "argv", ["train.py"])
    monkeypatch.chdir(tmp_path)


def pair(*shape):
    return torch.rand(shape, requires_grad=True), torch.rand(shape)


def plain(prediction, target):
    return torch.abs(prediction - target).mean()


def weighted(prediction, target, spec="legs"):
    return (weight_map(target, spec) * torch.abs(prediction - target)).mean()


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
            (((5, 3), (5, 3)), {}, r"got \[5, 3\]"),
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
        assert state.current_run().source.memo.bytes <= 9 * 8 * 4 + 1024

    @pytest.mark.parametrize("by", ["content", "identity"])
    def test_any_order_of_changing_targets_gets_its_own_weight(self, monkeypatch, by):
        if by == "identity":
            monkeypatch.setattr(memo, "_key", memo._identity_key)
            monkeypatch.setattr(memo.WeightMemo, "_owner", memo.WeightMemo._owner_of_memory)
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


@pytest.fixture
def scene(tmp_path):
    """Three photographs in a folder, with their stored maps."""
    folder = tmp_path / "scene" / "images"
    folder.mkdir(parents=True)
    generator = np.random.default_rng(0)
    for name in ("a.png", "b.png", "c.png"):
        Image.fromarray(generator.integers(0, 256, (9, 8, 3), dtype=np.uint8)).save(folder / name)
    precompute(read_scene(folder.parent))
    return folder.parent


def photograph(scene, name):
    return torch.from_numpy(np.array(Image.open(scene / "images" / name))).float().div(255).movedim(-1, 0)


class TestStore:
    def test_a_stored_map_is_used_for_its_own_image(self, scene):
        configure("legs", store=scene / "legs_weights")
        prediction, target = torch.rand(3, 9, 8, requires_grad=True), photograph(scene, "a.png")
        for _ in range(3):
            loss = l1_loss(prediction, target, view="a")
            torch.testing.assert_close(loss, weighted(prediction, target), rtol=1e-3, atol=0)
        assert (counts().stored, counts().computed, counts().remembered) == (1, 0, 2)

    def test_the_scene_after_minus_s_is_found_by_itself(self, scene, monkeypatch):
        monkeypatch.setattr(sys, "argv", ["train.py", "-s", str(scene)])
        l1_loss(torch.rand(3, 9, 8, requires_grad=True), photograph(scene, "b.png"), view="images/b.png")
        assert counts().stored == 1

    def test_on_the_cpu_it_is_found_without_a_name_or_under_another(self, scene, capsys):
        configure("legs", store=scene / "legs_weights")
        for name, view in (("a", None), ("b", "a"), ("c", "nowhere")):
            l1_loss(torch.rand(3, 9, 8, requires_grad=True), photograph(scene, name + ".png"), view=view)
        assert (counts().stored, counts().computed) == (3, 0)
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == 1 and f"maps from {scene / 'legs_weights'}" in lines[0]

    def test_the_first_line_says_what_was_used(self, scene, capsys):
        configure("legs", store=scene / "legs_weights")
        l1_loss(torch.rand(3, 9, 8, requires_grad=True), torch.rand(3, 9, 8))
        assert "weights computed from the training images" in capsys.readouterr().err
        configure("legs", store=scene / "legs_weights")
        state.reset_counts()
        batch = torch.stack([photograph(scene, "a.png"), torch.rand(3, 9, 8)])
        l1_loss(torch.rand(2, 3, 9, 8, requires_grad=True), batch)
        assert "but for 1 image(s), whose weight is computed" in capsys.readouterr().err

    def test_it_is_not_used_for_another_image_under_its_name(self, scene, capsys):
        configure("legs", store=scene / "legs_weights")
        prediction = torch.rand(3, 9, 8, requires_grad=True)
        for shift in (1, 2):
            target = torch.roll(photograph(scene, "a.png"), shift, dims=2)
            torch.testing.assert_close(l1_loss(prediction, target, view="a"), weighted(prediction, target))
        assert (counts().stored, counts().computed) == (0, 2)
        assert capsys.readouterr().err.count("is not the one that the stored map was made from") == 1

    def test_nor_for_another_size_or_finer_values_or_an_unknown_view(self, scene, capsys):
        configure("legs", store=scene / "legs_weights")
        target = photograph(scene, "a.png")
        l1_loss(torch.rand(3, 9, 8, requires_grad=True), target + 0.3 / 255)  # the same to 8 bits
        l1_loss(torch.rand(3, 8, 8, requires_grad=True), target[:, :8], view="a")
        l1_loss(torch.rand(3, 9, 8, requires_grad=True), torch.rand(3, 9, 8), view="z")
        assert (counts().stored, counts().computed) == (0, 3)
        assert "no map of view 'a' at 8x8" in capsys.readouterr().err

    def test_nor_for_another_operator(self, scene):
        configure("eggs", store=scene / "legs_weights")
        prediction, target = torch.rand(3, 9, 8, requires_grad=True), photograph(scene, "a.png")
        torch.testing.assert_close(l1_loss(prediction, target, view="a"), weighted(prediction, target, "eggs"))
        assert counts().stored == 0

    def test_a_damaged_store_is_said_once_and_computed(self, scene, capsys):
        for path in (scene / "legs_weights").glob("*.npy"):
            path.write_bytes(path.read_bytes()[:-1] + b"\xff")
        configure("legs", store=scene / "legs_weights")
        prediction = torch.rand(3, 9, 8, requires_grad=True)
        for name in ("a", "b", "c"):
            target = photograph(scene, name + ".png")
            torch.testing.assert_close(l1_loss(prediction, target, view=name), weighted(prediction, target))
        assert capsys.readouterr().err.count("its checksum differs") == 1

    def test_a_missing_store_is_said_and_computed(self, tmp_path, capsys):
        configure("legs", store=tmp_path / "nowhere")
        l1_loss(torch.rand(3, 9, 8, requires_grad=True), torch.rand(3, 9, 8), view="a")
        assert counts().computed == 1
        assert "is no store of weight maps" in capsys.readouterr().err


def test_the_one_line_import_costs_nothing_but_torch():
    script = (
        "import sys, torch; before = set(sys.modules); from legs_loss import l1_loss; "
        "new = {m.split('.')[0] for m in set(sys.modules) - before}; "
        "heavy = new & {'numba', 'kornia', 'libcst', 'matplotlib', 'PIL', 'scipy', 'tqdm'}; "
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


class TestBackends:
    @pytest.fixture(autouse=True)
    def needs_numba(self):
        pytest.importorskip("numba")
        if sys.version_info < (3, 8):
            pytest.skip("numba is not used on Python 3.7")

    def test_the_mean_is_one_fused_pass(self):
        prediction, target = pair(3, 30, 40)
        mask = torch.rand(30, 40)
        for options, expected in (({}, weighted(prediction, target)), ({"mask": mask}, None)):
            loss = l1_loss(prediction, target, **options)
            assert type(loss.grad_fn).__name__ == "_FusedLossBackward"
            if expected is None:
                expected = (mask * weight_map(target) * torch.abs(prediction - target)).mean()
            torch.testing.assert_close(loss, expected)
            gradients = [torch.autograd.grad(one, prediction)[0] for one in (loss, expected)]
            torch.testing.assert_close(*gradients, rtol=1e-4, atol=1e-9)
        assert state.current_run().source.memo.bytes == 0

    @pytest.mark.parametrize("options", [{"reduction": "none"}, {"own": plain}])
    def test_what_needs_the_map_gets_it(self, options):
        prediction, target = pair(3, 30, 40)
        loss = l1_loss(prediction, target, **options)
        torch.testing.assert_close(loss.mean(), weighted(prediction, target))
        l1_loss(prediction, target)
        assert (counts().computed, counts().remembered) == (2, 0)

    @pytest.mark.parametrize("spec", [WeightSpec(curve="C5"), WeightSpec(percentile=90.0), WeightSpec(error=0.5)])
    def test_specs_that_need_a_map(self, spec):
        configure(spec)
        prediction, target = pair(3, 30, 40)
        expected = error_weight_map(prediction, target, spec) if spec.error else weight_map(target, spec)
        for _ in range(2):
            loss = l1_loss(prediction, target)
            torch.testing.assert_close(loss, (expected * torch.abs(prediction - target)).mean())
        assert (counts().computed, counts().remembered) == (1, 1)


class TestCapture:
    """While a CUDA graph is captured nothing is remembered: replays have other pixels in the same memory."""

    def test_each_call_computes_its_own_weight(self, monkeypatch, scene):
        monkeypatch.setenv("LEGS_BACKEND", "torch")
        configure("legs", store=scene / "legs_weights")
        run = state.current_run()
        monkeypatch.setattr(sources, "is_capturing", lambda device: True)
        prediction, target = torch.rand(3, 9, 8, requires_grad=True), photograph(scene, "a.png")
        for _ in range(2):
            torch.testing.assert_close(l1_loss(prediction, target, view="a"), weighted(prediction, target))
            target.copy_(torch.rand(3, 9, 8))  # as a replay would find it
        assert (counts().computed, counts().stored, counts().remembered) == (2, 0, 0)
        assert len(run.source.memo) == 0

    def test_only_a_cuda_device_is_asked(self, monkeypatch):
        monkeypatch.setattr(torch.cuda, "is_current_stream_capturing", lambda: True)
        assert is_capturing(torch.device("cuda"))
        assert not is_capturing(torch.device("cpu"))
        monkeypatch.setattr(torch.cuda, "is_current_stream_capturing", lambda: False)
        assert not is_capturing(torch.device("cuda"))


class TestOtherDevices:
    """On the meta device reading a value is an error, so what works there never waits for a device."""

    @pytest.mark.parametrize("spec", ["legs", "eggs", WeightSpec(normalise="mean"), WeightSpec(percentile=99.0)])
    def test_a_step_reads_nothing_from_the_device(self, spec):
        if not isinstance(spec, str) and spec.percentile < 100 and not hasattr(torch, "compile"):
            pytest.skip("torch 1 has no kthvalue on this device")
        configure(spec)
        prediction = torch.empty(3, 16, 16, device="meta", requires_grad=True)
        target = torch.empty(4, 16, 16, device="meta")[:3]
        for _ in range(2):
            loss = l1_loss(prediction, target, view="a", mask=torch.empty(16, 16, device="meta"))
            loss.backward()
        assert loss.device.type == "meta"
        with pytest.raises((RuntimeError, NotImplementedError)):
            loss.item()

    def test_a_target_that_stays_is_computed_once(self):
        stored = torch.empty(4, 16, 16, device="meta")
        prediction = torch.empty(3, 16, 16, device="meta", requires_grad=True)
        for _ in range(3):
            l1_loss(prediction, stored[:3])
        assert (counts().computed, counts().remembered) == (1, 2)
        stored.add_(1)
        l1_loss(prediction, stored[:3])
        assert counts().computed == 2

    def test_devices_that_differ_are_named(self):
        with pytest.raises(LegsError, match="prediction is on cpu and target on meta"):
            l1_loss(torch.rand(3, 4, 4, requires_grad=True), torch.empty(3, 4, 4, device="meta"))


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
        return subprocess.run(command, env=environment, capture_output=True, text=True)

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
