"""A training step on the CUDA backend: no wait for the device, graph captures, failures."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from legs_loss import LegsError, configure, l1_loss, legs_loss, ssim
from legs_loss.kernels import available, backends, trial
from legs_loss.kernels.available import BACKENDS, Availability
from legs_loss.kernels.contract import SSIM
from legs_loss.kernels.cuda.backend import CudaBackend, Strides, Task, chunks_of, strip_of
from legs_loss.kernels.cuda.driver import DriverError
from legs_loss.kernels.cuda.modules import BinaryCache, Modules
from legs_loss.kernels.cuda.nvrtc import NotFound
from legs_loss.runtime import counts, state
from legs_loss.runtime.memo import _OVERHEAD
from legs_loss.spec import PRESETS
from legs_loss.weights import Weights
from tests.cuda_emulation import TRIED
from tests.kernels.parts import FakeCompiler, FakeDriver
from tests.kernels.support import fused, images, used

LEGS = PRESETS["legs"]


class TestLaunch:
    def test_every_row_is_done_by_one_block(self):
        for shape in ((1, 3, 1080, 1920), (1, 3, 533, 800), (2, 1, 7, 5), (1, 3, 2160, 3840)):
            for multiprocessors in (1, 30, 132):
                for wanted, core in ((True, 236), (False, 244)):
                    strip, blocks = strip_of(torch.empty(shape, device="meta"), multiprocessors, wanted)
                    assert strip % 4 == 0
                    assert blocks == shape[0] * shape[1] * -(-shape[2] // strip) * -(-shape[3] // core)

    def test_a_photograph_fills_a_large_gpu(self):
        _, blocks = strip_of(torch.empty(1, 3, 1080, 1920, device="meta"), 132, True)
        assert 0.8 * 264 <= blocks <= 528
        assert chunks_of(torch.empty(1, 3, 1080, 1920, device="meta")) == 8 * 135  # tiles of 256 columns, 8 rows

    def test_strides_beyond_31_bits_between_views_are_fine(self):
        task, layout = Task(), Strides(2**40, 2**33, 3840, 1)
        task.of_target = layout
        assert (task.of_target.view, task.of_target.channel) == (2**40, 2**33)

    def test_a_gradient_of_overlapping_windows_is_addressable(self, parts, monkeypatch):
        """As dense as memory is it would have rows of 2^24 values, and the last of them beyond 31 bits."""
        tasks = []
        monkeypatch.setattr(parts[0], "launch", lambda task, *kernels: tasks.append((kernels[0][0], task)))
        windows = torch.empty(1 << 17, device="meta").as_strided((1, 65536, 256, 256), (0, 1, 2, 512))
        backend = CudaBackend(lambda _: parts[2])
        backend.loss(SSIM, windows.requires_grad_(), torch.empty(windows.shape, device="meta"))
        layout = dict(tasks)["legs_ssim_gradient"].of_gradient
        assert 255 * (layout.row + layout.column) < 2**31


class Watched(TorchDispatchMode):
    """Note each operation that reads a value, or copies between devices."""

    def __init__(self):
        super().__init__()
        self.waits, self.seen = [], 0

    def __torch_dispatch__(self, function, types, arguments=(), kwargs=None):
        name = str(function)
        self.seen += 1
        if any(word in name for word in ("_local_scalar_dense", "item", "is_nonzero", "equal.default", "nonzero")):
            self.waits.append(name)
        if "_to_copy" in name and (kwargs or {}).get("device") is not None:
            self.waits.append(name)
        return function(*arguments, **(kwargs or {}))


@pytest.fixture
def on_meta(monkeypatch, parts):
    """The backend for tensors on torch's meta device, which have no values that could be read."""
    known = Availability(CudaBackend(lambda _: parts[2]), "", TRIED)
    monkeypatch.setattr(BACKENDS, "known", {"meta": ("cuda", "no module")})
    monkeypatch.setattr(BACKENDS, "found", {torch.device("meta"): known})
    monkeypatch.delenv("LEGS_BACKEND", raising=False)
    return parts[0]


class TestNothingWaits:
    @pytest.mark.parametrize("kind", ["spec", "map", "mask", "half", "five channels, last", "kept range", "l1", "ssim"])
    def test_no_operation_reads_a_value(self, on_meta, kind):
        shape = (2, 40, 50, 5) if kind.startswith("five") else (2, 3, 40, 50)
        prediction, target = (torch.empty(shape, device="meta") for _ in range(2))
        if kind == "half":
            prediction, target = prediction.half(), target.half()
        prediction.requires_grad_()
        one = torch.empty(40, 50, device="meta")
        with Watched() as watched:
            if kind == "l1":
                loss = fused("l1", prediction, target, Weights(spec=LEGS))
            elif kind == "ssim":
                loss = fused("ssim", prediction, target)
            elif kind == "kept range":
                found = backends.fused_range(target, LEGS)
                loss = fused("l1", prediction, target, Weights(spec=LEGS, range=found))
            else:
                options = {
                    "map": {"weight": one},
                    "mask": {"mask": one, "renormalise": True},
                    "five channels, last": {"channels_last": True},
                }
                loss = legs_loss(prediction, target, **options.get(kind, {}))
            loss.backward()
        assert used(loss) == "fused" and on_meta.launches[-1] == "legs_scale"
        assert prediction.grad.shape == shape and prediction.grad.dtype == prediction.dtype
        assert watched.seen > 0 and not watched.waits

    def test_a_patched_scripts_step_launches_six_kernels_and_remembers_its_view(self, on_meta):
        prediction, target = (torch.empty(3, 40, 50, device="meta") for _ in range(2))
        prediction.requires_grad_()
        configure("legs")
        for step in range(2):
            with Watched() as watched:
                loss, similarity = l1_loss(prediction, target, view="a"), ssim(prediction, target)
                (0.8 * loss + 0.2 * (1.0 - similarity)).backward()
            assert used(loss) == used(similarity) == "fused" and not watched.waits
            found = ["legs_range", "legs_range_finish"] if step == 0 else []
            sums = ["legs_l1_gradient", "legs_finish", "legs_ssim_gradient", "legs_finish"]
            assert on_meta.launches == [*found, *sums, "legs_scale", "legs_scale"]
            on_meta.launches.clear()

    def test_the_watch_sees_what_waits(self):
        with Watched() as watched:
            bool(torch.ones(1).sum() > 0)
            torch.ones(1).to("meta")
        assert len(watched.waits) == 2

    def test_launches_of_a_step(self, on_meta):
        prediction, target = (torch.empty(3, 1080, 1920, device="meta") for _ in range(2))
        loss = legs_loss(prediction.requires_grad_(), target)
        assert on_meta.launches == ["legs_range", "legs_range_finish", "legs_loss_gradient", "legs_finish"]
        loss.backward()
        assert on_meta.launches[4:] == ["legs_scale"]


class TestDropIn:
    """`l1_loss` and `ssim`, which a patched script calls."""

    @pytest.fixture(autouse=True)
    def fresh(self):
        state.reset()
        configure("legs")
        yield
        state.reset()

    def test_a_step_waits_for_nothing_and_remembers_two_numbers_a_view(self, on_meta):
        stored = [torch.empty(4, 40, 50, device="meta") for _ in range(2)]
        prediction = torch.empty(3, 40, 50, device="meta", requires_grad=True)
        with Watched() as watched:
            for step in range(4):
                target = stored[step % 2][:3]  # a new view of the same memory at each step
                loss = 0.8 * l1_loss(prediction, target, view="a") + 0.2 * (1.0 - ssim(prediction, target))
                loss.backward()
        assert used(loss) == "fused" and watched.seen > 0 and not watched.waits
        assert on_meta.launches.count("legs_range") == 2
        assert (counts().computed, counts().remembered) == (2, 2)
        assert state.current_run().memo.bytes == 2 * _OVERHEAD

    def test_a_capture_makes_the_range_part_of_the_graph(self, on_meta, monkeypatch):
        target = torch.empty(3, 40, 50, device="meta")
        prediction = torch.empty(3, 40, 50, device="meta", requires_grad=True)
        l1_loss(prediction, target)
        monkeypatch.setattr(state, "is_capturing", lambda device: True)
        for _ in range(2):
            assert used(l1_loss(prediction, target)) == "fused"
        assert on_meta.launches.count("legs_range") == 3
        assert (counts().computed, counts().remembered) == (3, 0)


class TestCapture:
    def test_a_kernel_that_is_not_loaded_is_torchs_while_a_capture_lasts(self, monkeypatch, tmp_path):
        driver = FakeDriver()
        backend = CudaBackend(lambda _: Modules(driver, FakeCompiler(), BinaryCache(tmp_path)))
        monkeypatch.setattr(BACKENDS, "known", {"cpu": ("cuda", "no module")})
        known = Availability(backend, "", TRIED)
        monkeypatch.setattr(BACKENDS, "found", {torch.device("cpu"): known})
        prediction, target = images((3, 20, 30))
        driver.captures = True
        assert used(legs_loss(prediction, target)) == "torch" and not driver.launches
        driver.captures = False
        assert used(legs_loss(prediction, target)) == "fused"
        driver.captures = True
        loss = legs_loss(prediction, target)
        loss.backward()
        assert used(loss) == "fused" and driver.launches[-1] == "legs_scale"

    def test_the_trial_does_not_run_in_a_capture(self, monkeypatch):
        monkeypatch.setattr(BACKENDS, "found", {})
        monkeypatch.setattr(available, "is_capturing", lambda device: True)
        monkeypatch.setattr(trial, "difference_from_torch", lambda *_: pytest.fail("a trial waits for the device"))
        assert used(legs_loss(*images((3, 20, 30)))) == "torch"
        assert not BACKENDS.found


class TestFailures:
    @pytest.mark.parametrize(
        ("error", "said"),
        [
            (NotFound("no NVRTC of CUDA 12.4 was found"), "NotFound: no NVRTC of CUDA 12.4 was found"),
            (OSError("libcuda.so.1: cannot open"), "OSError: libcuda.so.1: cannot open"),
            (DriverError("cuModuleLoadData failed"), "DriverError: cuModuleLoadData failed"),
        ],
    )
    def test_what_cannot_load_is_said_once_and_torch_computes(self, monkeypatch, capfd, error, said):
        def broken(_):
            raise error

        module = SimpleNamespace(BACKEND=CudaBackend(broken))
        monkeypatch.setattr(BACKENDS, "known", {"cpu": ("cuda", "broken")})
        monkeypatch.setattr(BACKENDS, "found", {})
        monkeypatch.setattr(available.importlib, "import_module", lambda name: module)
        monkeypatch.setattr(available, "_why_missing", lambda name: None)
        for _ in range(2):
            assert used(legs_loss(*images((3, 20, 30)))) == "torch"
        assert capfd.readouterr().err == f"legs-loss: cuda is unavailable, torch is used: {said}\n"

    def test_a_torch_without_cuda_is_no_failure(self, monkeypatch, capfd):
        monkeypatch.setattr(BACKENDS, "found", {})
        monkeypatch.setattr(torch.version, "cuda", None)
        found = BACKENDS.availability(torch.device("cuda", 0))
        assert found == Availability(None, "this torch is built without CUDA")
        assert capfd.readouterr().err == ""

    def test_images_that_do_not_fit_their_map_are_still_an_error(self, on_meta):
        with pytest.raises(LegsError, match="weight"):
            legs_loss(*(torch.empty(3, 8, 8, device="meta") for _ in range(2)), weight=torch.empty(4, 4, device="meta"))

    def test_shares(self, parts):
        assert CudaBackend(lambda _: parts[2]).loss(SSIM, *(torch.empty(3, 8, 8, device="meta"),) * 2).dim() == 0
        assert parts[0].launches == ["legs_ssim_value", "legs_finish"]
