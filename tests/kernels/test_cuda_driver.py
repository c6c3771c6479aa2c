"""The driver, the modules and the choice of a backend against a libcuda and a libnvrtc that fail as the real ones."""

from __future__ import annotations

import os
import sys
import threading
from types import SimpleNamespace

import pytest
import torch

from legs_loss import legs_loss
from legs_loss.kernels import available, trial
from legs_loss.kernels.available import BACKENDS
from legs_loss.kernels.contract import L1, SSIM, DeviceFault, NotNow, terms_of
from legs_loss.kernels.cuda import driver as driver_module
from legs_loss.kernels.cuda.backend import THREADS, CudaBackend, Task
from legs_loss.kernels.cuda.driver import CudaDriver, DriverError, OutOfMemory
from legs_loss.kernels.cuda.modules import PLAIN, BinaryCache, Modules, Variant
from legs_loss.kernels.cuda.nvrtc import Compiler, CompilerError
from legs_loss.spec import PRESETS
from legs_loss.weights import Weights
from tests.cuda_emulation import COMPILER, Runtime, libraries
from tests.kernels.support import images, used
from tests.preloaded import run
from tests.support import legs_environment

WEIGHTS = Weights(spec=PRESETS["legs"])

pytestmark = pytest.mark.skipif(COMPILER is None, reason="needs g++")


@pytest.fixture
def cuda():
    found = libraries()
    found.cuda.test_reset()
    yield found.cuda
    found.cuda.test_reset()
    found.cuda.cuCtxSetCurrent(None)


@pytest.fixture
def runtime():
    return Runtime()


@pytest.fixture
def driver(cuda, runtime):
    return CudaDriver(torch.device("cpu"), cuda, runtime)


@pytest.fixture
def modules(driver, tmp_path):
    return Modules(driver, Compiler(libraries().nvrtc), BinaryCache(libraries().cache))


def sums(modules, values):
    """Launch legs_finish on partial sums of two blocks; return the loss."""
    partial, result = torch.tensor(values), torch.zeros(())
    task = Task(partial=partial.data_ptr(), result=result.data_ptr(), count=2)
    modules.driver.launch(task, (modules.function("legs_finish", PLAIN), 1, THREADS))
    return result.item()


class TestLaunch:
    def test_a_kernel_is_launched_through_the_driver(self, modules, cuda):
        assert sums(modules, [1.0, 2.0]) == 3.0
        assert cuda.test_calls(b"cuLaunchKernel") == 1
        assert cuda.test_current_device() == -1  # the thread has again the context that it had

    def test_a_thread_of_its_own_gets_the_context(self, modules):
        modules.load(PLAIN)
        found = []
        thread = threading.Thread(target=lambda: found.append(sums(modules, [3.0, 5.0])))
        thread.start()
        thread.join()
        assert found == [8.0]

    def test_two_devices_have_contexts_of_their_own(self, cuda, runtime):
        built = []
        for index in (0, 1):
            second = SimpleNamespace(**{name: getattr(runtime, name) for name in dir(runtime) if name[0] != "_"})
            second.current_device = lambda index=index: index
            driver = CudaDriver(torch.device("cpu"), cuda, second)
            built.append(Modules(driver, Compiler(libraries().nvrtc), BinaryCache(libraries().cache)))
        assert [sums(each, [2.0, 2.0]) for each in built] == [4.0, 4.0]
        foreign = built[0].function("legs_finish", PLAIN)
        with pytest.raises(DriverError, match=r"cuLaunchKernel failed: .*\(400\)"):
            built[1].driver.launch(Task(), (foreign, 1, THREADS))

    @pytest.mark.parametrize(("blocks", "threads", "code"), [(2**31, THREADS, 1), (0, THREADS, 1), (1, 128, 701)])
    def test_what_the_hardware_refuses_is_an_error(self, modules, blocks, threads, code):
        with pytest.raises(DriverError, match=rf"cuLaunchKernel failed: .*\({code}\)"):
            modules.driver.launch(Task(), (modules.function("legs_finish", PLAIN), blocks, threads))


class TestLoading:
    def test_a_full_card_is_tried_again_after_torch_gave_memory_back(self, modules, cuda, runtime):
        cuda.test_fail(b"cuModuleLoadData", 2, 1)
        assert sums(modules, [1.0, 1.0]) == 2.0
        assert runtime.emptied == 1

    def test_a_card_that_stays_full_is_for_torch_this_once(self, modules, cuda):
        cuda.test_fail(b"cuModuleLoadData", 2, 2)
        with pytest.raises(OutOfMemory, match=r"cuModuleLoadData failed: out of memory \(2\)"):
            modules.load(PLAIN)
        assert issubclass(OutOfMemory, NotNow)
        modules.load(PLAIN)

    def test_a_binary_on_disk_that_does_not_load_is_compiled_again(self, driver, cuda, tmp_path):
        compiled = []

        class Counting(Compiler):
            def compile(self, *arguments):
                compiled.append(arguments[2])
                return super().compile(*arguments)

        cache = BinaryCache(tmp_path / "kernels")
        Modules(driver, Counting(libraries().nvrtc), cache).load(PLAIN)
        (file,) = cache.folder.iterdir()
        os.utime(str(file), (1, 1))
        cuda.test_fail(b"cuModuleLoadData", 200, 1)
        Modules(driver, Counting(libraries().nvrtc), cache).load(PLAIN)
        Modules(driver, Counting(libraries().nvrtc), cache).load(PLAIN)
        assert compiled == [Compiler(libraries().nvrtc).target(86)] * 2
        (file,) = cache.folder.iterdir()
        assert file.stat().st_mtime > 1

    def test_a_gpu_that_is_newer_than_the_compiler_and_an_old_driver(self, cuda, tmp_path):
        driver = CudaDriver(torch.device("cpu"), cuda, Runtime(architecture=(12, 0)))
        modules = Modules(driver, Compiler(libraries().nvrtc), BinaryCache(tmp_path / "kernels"))
        cuda.test_fail(b"cuModuleLoadData", 222, 1)
        with pytest.raises(DriverError) as raised:
            modules.load(PLAIN)
        assert str(raised.value) == (
            "the GPU (sm_120) is newer than torch's NVRTC 12.9, and the driver too old for its PTX: update the driver, "
            "or install a torch for a newer CUDA"
        )
        modules.load(PLAIN)  # with a newer driver its PTX loads
        assert sums(modules, [1.0, 3.0]) == 4.0

    def test_a_source_that_does_not_compile_says_where(self, modules, monkeypatch):
        monkeypatch.setattr("legs_loss.kernels.cuda.modules.source", lambda: b"int bad = missing;\n")
        with pytest.raises(CompilerError, match="missing"):
            modules.load(Variant(0, 1, 1))

    def test_a_capture_of_another_thread_outlives_what_is_loaded_meanwhile(self, modules, cuda):
        cuda.test_capture(1)
        assert sums(modules, [1.0, 2.0]) == 3.0
        assert cuda.test_capture_is_valid()

    def test_the_stand_in_ends_a_capture_where_the_mode_is_not_relaxed(self, driver, cuda, monkeypatch):
        cuda.test_capture(1)
        binary = Compiler(libraries().nvrtc).compile(b"struct Task {};", [], "sm_86")[0]
        monkeypatch.setattr(driver_module, "_RELAXED", 0)
        with pytest.raises(DriverError, match=r"\(900\)"):
            driver.load(binary)
        assert not cuda.test_capture_is_valid()

    def test_all_that_a_configuration_needs_is_loaded_at_its_first_call(self, modules, cuda, runtime):
        backend = CudaBackend(lambda device: modules)
        prediction, target = images((3, 20, 30))
        for dtype in (torch.float32, torch.float16):
            first = prediction.detach().to(dtype).requires_grad_(), target.to(dtype)
            backend.loss(L1, *first, WEIGHTS)
            runtime.captures = True  # nothing more may be loaded now
            for loss in (backend.loss(L1, *first, WEIGHTS), backend.loss(terms_of(0.2), *first, WEIGHTS)):
                loss.backward()
            backend.loss(SSIM, *first).backward()
            with torch.no_grad():
                backend.loss(terms_of(0.2), *first, WEIGHTS)
            runtime.captures = False


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="owners and modes are POSIX's")
class TestWhoseFiles:
    """A binary of the cache runs on the card: as ssh, it takes nothing that somebody else may have written."""

    @pytest.mark.parametrize("mode", [0o777, 0o770, 0o722])
    @pytest.mark.parametrize("what", ["folder", "file"])
    def test_what_others_may_write_is_not_run(self, tmp_path, what, mode):
        cache = BinaryCache(tmp_path / "kernels")
        cache.put(b"key", b"binary")
        (file,) = cache.folder.iterdir()
        (cache.folder if what == "folder" else file).chmod(mode)
        assert cache.get(b"key") is None
        if what == "folder":
            cache.put(b"other", b"binary")
            assert [path.name for path in cache.folder.iterdir()] == [file.name]

    def test_what_another_user_owns_is_not_run(self, tmp_path, monkeypatch):
        cache = BinaryCache(tmp_path / "kernels")
        cache.put(b"key", b"binary")
        assert cache.get(b"key") == b"binary"
        user = os.getuid()
        monkeypatch.setattr(os, "getuid", lambda: user + 1)
        assert cache.get(b"key") is None


@pytest.fixture
def on_cpu(modules, cuda, monkeypatch):
    """Make the CUDA backend, behind the stand-in libraries, the untried one for images on the CPU."""
    monkeypatch.setattr(BACKENDS, "known", {"cpu": ("cuda", "stand-in")})
    monkeypatch.setattr(BACKENDS, "found", {})
    backend = CudaBackend(lambda device: modules)
    monkeypatch.setattr(available.importlib, "import_module", lambda name: SimpleNamespace(BACKEND=backend))
    monkeypatch.setattr(available, "_why_missing", lambda name: None)
    monkeypatch.delenv("LEGS_BACKEND", raising=False)
    return cuda


class TestAvailability:
    def test_the_trial_is_launched_through_the_driver(self, on_cpu):
        assert used(legs_loss(*images((3, 20, 30)))) == "fused"
        assert on_cpu.test_calls(b"cuLaunchKernel") > 10

    def test_a_card_that_is_full_during_the_trial_is_tried_again_later(self, on_cpu, capfd):
        on_cpu.test_fail(b"cuModuleLoadData", 2, 2)
        assert used(legs_loss(*images((3, 20, 30)))) == "torch"
        assert used(legs_loss(*images((3, 20, 30)))) == "fused"
        assert capfd.readouterr().err == ""

    def test_a_card_that_is_full_later_is_torchs_once(self, on_cpu, capfd):
        assert used(legs_loss(*images((3, 20, 30)))) == "fused"
        on_cpu.test_fail(b"cuModuleLoadData", 2, 2)
        halves = [image.detach().half().requires_grad_(image.requires_grad) for image in images((3, 20, 30))]
        losses = [legs_loss(*halves) for _ in range(2)]
        assert [used(loss) for loss in losses] == ["torch", "fused"]
        assert capfd.readouterr().err == ""

    @pytest.mark.parametrize(("code", "words"), [(700, "an illegal memory access"), (719, "unspecified launch fail")])
    def test_a_fault_of_somebody_elses_kernel_is_raised_as_what_it_is(self, on_cpu, capfd, code, words):
        assert used(legs_loss(*images((3, 20, 30)))) == "fused"
        on_cpu.test_fail(b"cuLaunchKernel", code, 1)
        for _ in range(2):  # from then on every call fails
            with pytest.raises(DeviceFault, match=rf"CUDA error: {words}.*\({code}\), of a kernel .* launched before"):
                legs_loss(*images((3, 20, 30)))
        assert capfd.readouterr().err == ""

    def test_a_fault_before_the_trial_is_raised_too(self, on_cpu, capfd):
        on_cpu.test_fail(b"cuLaunchKernel", 700, 1)
        with pytest.raises(DeviceFault):
            legs_loss(*images((3, 20, 30)))
        assert not BACKENDS.found and capfd.readouterr().err == ""

    def test_each_device_is_tried_by_itself(self, monkeypatch, capfd):
        monkeypatch.setattr(BACKENDS, "found", {})
        monkeypatch.setattr(available, "_why_missing", lambda name: None)
        problems = {torch.device("cuda", 0): "its card is odd", torch.device("cuda", 1): None}
        monkeypatch.setattr(trial, "difference_from_torch", lambda backend, device, *_: problems[device])
        found = [BACKENDS.availability(torch.device("cuda", index)) for index in (0, 1)]
        assert found[0].backend is None and found[1].backend is not None
        assert capfd.readouterr().err == "legs-loss: cuda is unavailable, torch is used: its card is odd\n"


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_a_forked_process_uses_both():
    pytest.importorskip("numba")
    code = (
        "import os, torch\nfrom legs_loss.kernels import available, trial\n"
        "from legs_loss.kernels.available import BACKENDS\n"
        "cpu, card = torch.device('cpu'), torch.device('cuda', 0)\n"
        "assert BACKENDS.chosen(cpu) == 'numba'\n"
        "child = os.fork()\n"
        "if child == 0:\n"
        "    assert BACKENDS.chosen(cpu) == 'numba'\n"
        "    available._why_missing = lambda name: None\n"
        "    trial.difference_from_torch = lambda *_: None\n"
        "    assert BACKENDS.chosen(card) == 'cuda'\n"
        "    os._exit(0)\n"
        "assert os.waitpid(child, 0)[1] == 0\n"
        "assert BACKENDS.chosen(cpu) == 'numba'\n"
    )
    environment = legs_environment()
    environment.pop("LEGS_BACKEND", None)
    done = run([sys.executable, "-c", code], env=environment)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
