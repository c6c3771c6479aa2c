"""torch.cuda answered by the CPU: each point of the redirection by itself."""

from __future__ import annotations

import concurrent.futures
import io
import multiprocessing
import os
import pickle
import threading
import time

import numpy as np
import pytest
import torch
import torch.utils.data
from legs_adapters.shims.missing import MissingShim
from legs_adapters.shims.torch_cuda import redirect

NEW = hasattr(torch, "set_default_device")  # torch 2.0
needs_new = pytest.mark.skipif(not NEW, reason="torch before 2.0 has no default device")
# Made before anything is redirected: what was bound early stays what it was.
original_zeros = torch.zeros
original_save = torch.save


@pytest.fixture(autouse=True)
def redirected():
    with redirect() as redirection:
        yield redirection
    assert torch.zeros is original_zeros


def square(x):
    return x * x


class TestTensors:
    @pytest.mark.parametrize("device", ["cuda", "cuda:0", torch.device("cuda"), torch.device("cuda", 1), 0])
    def test_every_name_of_a_device(self, device):
        assert torch.zeros(2, device=device).device.type == "cpu"
        assert torch.ones(2).to(device).device.type == "cpu"

    def test_other_devices_stay(self):
        assert torch.zeros(2, device="meta").device.type == "meta"
        assert torch.zeros(2).to("meta").device.type == "meta"

    @pytest.mark.parametrize(
        ("name", "arguments"),
        [
            ("empty", (2,)),
            ("zeros", (2,)),
            ("ones", (2,)),
            ("full", ((2,), 1.0)),
            ("rand", (2,)),
            ("randn", (2,)),
            ("randint", (0, 5, (2,))),
            ("randperm", (4,)),
            ("normal", (0.0, 1.0, (2,))),
            ("arange", (3,)),
            ("linspace", (0, 1, 3)),
            ("logspace", (0, 1, 3)),
            ("eye", (2,)),
            ("tensor", ([1.0],)),
            ("as_tensor", ([1.0],)),
            ("scalar_tensor", (1.0,)),
            ("hann_window", (3,)),
            ("empty_strided", ((2,), (1,))),
            ("sparse_coo_tensor", ([[0]], [1.0], (2,))),
            ("tril_indices", (2, 2)),
        ],
    )
    def test_constructors(self, name, arguments):
        assert getattr(torch, name)(*arguments, device="cuda").device.type == "cpu"

    def test_every_constructor_that_torch_lists(self, redirected):
        if not NEW:
            pytest.skip("torch before 2.0 has no such list")
        from torch.utils._device import _device_constructors

        originals = {entry[2] for entry in redirected._replaced if callable(entry[2])}
        assert set(_device_constructors()) <= originals | {torch.nested.nested_tensor}

    def test_pinned_memory_is_memory(self):
        assert torch.zeros(2, pin_memory=True).device.type == "cpu"
        assert torch.zeros(2).pin_memory().device.type == "cpu"

    @pytest.mark.parametrize("name", ["zeros_like", "ones_like", "empty_like", "rand_like", "randn_like"])
    def test_like(self, name):
        assert getattr(torch, name)(torch.ones(2), device="cuda").device.type == "cpu"
        assert torch.full_like(torch.ones(2), 3.0, device="cuda").device.type == "cpu"

    def test_new(self):
        x = torch.ones(2)
        made = [x.new_zeros(2, device="cuda"), x.new_ones(2, device="cuda"), x.new_empty(2, device="cuda")]
        made += [x.new_full((2,), 1.0, device="cuda"), x.new_tensor([1.0], device="cuda")]
        assert all(tensor.device.type == "cpu" for tensor in made)

    def test_to_and_cuda(self):
        x = torch.ones(2)
        assert x.cuda() is x
        assert x.cuda(0, non_blocking=True) is x
        assert x.to("cuda", torch.float64).dtype == torch.float64
        assert x.to(device="cuda", dtype=torch.int32).dtype == torch.int32
        assert x.to(torch.float16).dtype == torch.float16
        assert x.to(torch.zeros(1, dtype=torch.int64)).dtype == torch.int64

    def test_what_leaves_the_gpu_is_a_copy(self):
        x = torch.ones(2)
        for kept in (x.cpu(), x.to("cpu"), x.to(device="cpu")):
            x += 1
            assert kept[0] != x[0]

    def test_what_stays_beside_another_tensor_is_none(self):
        x, y = torch.ones(2, device="cuda"), torch.ones(2, device="cuda")
        assert x.to(y.device) is x

    def test_parameters_stay_leaves(self):
        parameter = torch.nn.Parameter(torch.ones(2).cuda())
        assert parameter.cuda().is_leaf
        assert parameter.to("cuda") is parameter

    def test_legacy_types(self):
        x = torch.cuda.FloatTensor([1, 2])
        assert x.dtype == torch.float32
        assert torch.cuda.LongTensor(3).shape == (3,)
        assert isinstance(x, torch.cuda.FloatTensor)
        assert not isinstance(x, torch.cuda.LongTensor)
        assert x.type(torch.cuda.LongTensor).dtype == torch.int64
        assert x.type("torch.cuda.HalfTensor").dtype == torch.float16
        assert x.type() == "torch.FloatTensor"

    def test_default_tensor_type(self):
        try:
            torch.set_default_tensor_type("torch.cuda.DoubleTensor")
            assert torch.zeros(1).dtype == torch.float64
            torch.set_default_tensor_type(torch.cuda.FloatTensor)
            assert torch.zeros(1).dtype == torch.float32
        finally:
            torch.set_default_dtype(torch.float32)

    def test_generator_is_a_class(self):
        generator = torch.Generator("cuda")
        assert isinstance(generator, torch.Generator)
        assert isinstance(torch.default_generator, torch.Generator)
        assert generator.device.type == "cpu"
        generator.manual_seed(3)
        first = torch.rand(2, generator=generator, device="cuda")
        generator.manual_seed(3)
        assert torch.equal(first, torch.rand(2, generator=generator, device="cuda"))

    def test_modules(self):
        layer = torch.nn.Linear(2, 2)
        assert layer.cuda() is layer
        assert layer.to("cuda") is layer
        assert layer.to(device=torch.device("cuda"), dtype=torch.float64).weight.dtype == torch.float64
        assert layer.cpu() is layer
        assert torch.nn.Linear(2, 2, device="cuda").weight.device.type == "cpu"


class TestWhereAModeWouldNotReach:
    def test_backward_functions(self):
        class Twice(torch.autograd.Function):
            @staticmethod
            def forward(ctx, x):
                return 2 * x

            @staticmethod
            def backward(ctx, g):
                return g + torch.ones(1, device="cuda")

        x = torch.ones(1, requires_grad=True)
        Twice.apply(x).backward()
        assert x.grad.item() == 2

    def test_other_threads(self):
        found = []
        thread = threading.Thread(target=lambda: found.append(torch.zeros(1, device="cuda").device.type))
        thread.start()
        thread.join()
        assert found == ["cpu"]

    @needs_new
    def test_after_a_default_device(self):
        try:
            torch.set_default_device("cuda")
            assert torch.zeros(1).device.type == "cpu"
            assert torch.zeros(1, device="cuda").device.type == "cpu"
        finally:
            torch.set_default_device(None)

    @needs_new
    def test_in_a_device_s_context(self):
        with torch.device("cuda"):
            assert torch.zeros(1).device.type == "cpu"
            assert torch.nn.Linear(1, 1).weight.device.type == "cpu"


class Anything:
    """An object as old checkpoints hold it beside tensors."""


class RunsCode:
    """An object that runs something when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


class TestLoading:
    @pytest.mark.parametrize("place", [None, "cuda", torch.device("cuda"), "cpu", lambda storage, where: storage])
    def test_map_location(self, place):
        file = io.BytesIO()
        torch.save({"x": torch.ones(2), "it": 7}, file)
        file.seek(0)
        assert torch.load(file, map_location=place)["x"].device.type == "cpu"

    def test_what_the_run_itself_saved_is_loaded_whole(self, tmp_path):
        buffer = io.BytesIO()
        for place in (tmp_path / "own.pth", str(tmp_path / "named.pth"), buffer):
            torch.save((Anything(), 3), place)
            buffer.seek(0)
            found, iteration = torch.load(place)
            assert isinstance(found, Anything)
            assert iteration == 3
        with open(str(tmp_path / "own.pth"), "rb") as file:
            assert torch.load(file)[1] == 3

    @pytest.mark.skipif(torch.__version__.startswith("1.12."), reason="torch 1.12 has no safe load")
    def test_a_stranger_s_file_is_not_unpickled(self, tmp_path, monkeypatch):
        ran = tmp_path / "ran"
        path = tmp_path / "theirs.pth"
        original_save((RunsCode(ran), torch.ones(1)), str(path))
        with pytest.raises(pickle.UnpicklingError, match=r"theirs\.pth holds more than .* did not write it"):
            torch.load(str(path))
        assert not ran.exists()
        torch.load(str(path), weights_only=False)  # asked for by name, in the script
        assert ran.exists()
        ran.rmdir()
        monkeypatch.setenv("TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD", "1")  # or by the user
        torch.load(str(path))
        assert ran.exists()

    @pytest.mark.skipif(not hasattr(torch.serialization, "safe_globals"), reason="torch before 2.5 has no list of them")
    def test_a_checkpoint_of_3dgs_from_an_earlier_run(self, tmp_path):
        parameter = torch.nn.Parameter(torch.ones(3))
        optimizer = torch.optim.Adam([{"params": [parameter], "lr": 0.1, "name": "xyz"}], eps=1e-15)
        parameter.sum().backward()
        optimizer.step()
        extent = np.float32(4.5) * 1.1
        original_save(((3, parameter, optimizer.state_dict(), extent, np.float32(2)), 7000), tmp_path / "chkpnt.pth")
        (degree, found, state, radius, single), iteration = torch.load(tmp_path / "chkpnt.pth")
        assert (degree, float(radius), float(single), iteration) == (3, float(extent), 2.0, 7000)
        assert torch.equal(found, parameter)
        assert state["param_groups"][0]["name"] == "xyz"


class TestRuntime:
    @pytest.mark.skipif(not hasattr(torch, "accelerator"), reason="torch before 2.6 has no accelerator")
    def test_torch_itself_sees_no_accelerator_whatever_it_was_built_for(self):
        assert not torch.accelerator.is_available()
        assert torch.accelerator.current_accelerator() is None
        weight = torch.nn.Parameter(torch.ones(2, device="cuda"))
        optimizer = torch.optim.Adam([weight], lr=0.1)
        weight.sum().backward()
        optimizer.step()
        assert (weight < 1).all()

    def test_there_is_a_device(self):
        assert torch.cuda.is_available()
        assert torch.cuda.device_count() == 1
        assert torch.cuda.current_device() == 0
        torch.cuda.set_device(torch.device("cuda:0"))
        torch.cuda.synchronize()
        torch.cuda.empty_cache()
        torch.cuda.manual_seed_all(3)
        assert torch.cuda.get_device_name(0) == "CPU"
        assert torch.cuda.get_device_properties(0).total_memory > 0
        with torch.cuda.device(0):
            torch.cuda.nvtx.range_push("step")
            torch.cuda.nvtx.range_pop()

    def test_events_take_the_time(self):
        start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        start.record()
        time.sleep(0.02)
        end.record()
        end.synchronize()
        assert 15 < start.elapsed_time(end) < 5000

    def test_streams(self):
        stream = torch.cuda.Stream()
        with torch.cuda.stream(stream):
            stream.wait_stream(torch.cuda.current_stream())
        stream.synchronize()
        torch.zeros(1).record_stream(stream)

    def test_memory_statistics(self):
        assert torch.cuda.max_memory_allocated() / 2**20 == 0
        assert torch.cuda.memory_stats()["allocated_bytes.all.peak"] == 0
        torch.cuda.reset_peak_memory_stats()
        free, total = torch.cuda.mem_get_info()
        assert 0 < free <= total

    def test_mixed_precision_is_off(self):
        scaler = torch.cuda.amp.GradScaler()
        with torch.cuda.amp.autocast():
            product = torch.ones(2, 2) @ torch.ones(2, 2)
        assert product.dtype == torch.float32
        with torch.autocast("cuda", dtype=torch.float16):
            assert (product @ product).dtype == torch.float32
        assert scaler.scale(product.sum()).item() == 8
        assert not scaler.is_enabled()

    def test_adam_takes_its_fused_step(self):
        start, gradients = np.array([1.0, -2.0, 0.5]), np.random.RandomState(0).randn(3, 3)
        parameter = torch.nn.Parameter(torch.tensor(start, dtype=torch.float32))
        optimizer = torch.optim.Adam([{"params": [parameter], "lr": 0.1}], lr=0.0, eps=1e-15)
        first = second = np.zeros(3)
        for step, gradient in enumerate(gradients, 1):
            parameter.grad = torch.tensor(gradient, dtype=torch.float32)
            optimizer.step()
            first, second = 0.9 * first + 0.1 * gradient, 0.999 * second + 0.001 * gradient**2
            start = start - 0.1 * (first / (1 - 0.9**step)) / np.sqrt(second / (1 - 0.999**step))
        assert parameter.detach().numpy() == pytest.approx(start, rel=1e-5)
        old = tuple(map(int, torch.__version__.split(".")[:2])) < (2, 4)
        assert optimizer.param_groups[0].get("fused") is (None if old else True)

    @needs_new
    def test_an_adam_that_a_script_chose_stays(self):
        class Own(torch.optim.Adam):
            pass

        parameter = torch.nn.Parameter(torch.zeros(2))
        assert not torch.optim.Adam([parameter], foreach=False).param_groups[0]["fused"]
        assert not Own([parameter]).param_groups[0]["fused"]
        assert not torch.optim.Adam([torch.nn.Parameter(torch.zeros(2) * 1j)]).param_groups[0]["fused"]

    def test_scripts_for_the_compiler_run_as_they_are(self):
        assert torch.jit.script(square) is square

    def test_each_replacement_is_an_object_of_its_own(self, redirected):
        pools = {"Pool", "ProcessPoolExecutor"}
        replaced = [getattr(owner, name) for owner, name, _, _ in redirected._replaced if name not in pools]
        assert len({id(each) for each in replaced}) == len(replaced)

    @needs_new
    def test_the_compiler_s_table_of_torch_can_be_made(self):
        from torch._dynamo import trace_rules

        assert len(trace_rules.get_torch_obj_rule_map.__wrapped__()) > 1000


class TestProcesses:
    def test_pools_are_of_threads(self):
        with concurrent.futures.ProcessPoolExecutor(2) as pool:
            assert list(pool.map(lambda x: (x * x, os.getpid()), [3])) == [(9, os.getpid())]
        with multiprocessing.Pool(2) as pool:
            assert pool.map(square, [1, 2, 3]) == [1, 4, 9]
        with multiprocessing.get_context("spawn").Pool(2) as pool:
            assert pool.map(lambda x: x + 1, [1]) == [2]
        with torch.multiprocessing.Pool(2) as pool:
            assert pool.map(square, [4]) == [16]

    def test_loaders_pin_nothing(self):
        data = torch.utils.data.TensorDataset(torch.arange(4))
        loader = torch.utils.data.DataLoader(data, batch_size=2, pin_memory=True)
        assert [batch[0].tolist() for batch in loader] == [[0, 1], [2, 3]]


class TestRefusals:
    @pytest.mark.parametrize(
        ("what", "named"),
        [
            (lambda: torch.cuda.CUDAGraph(), "torch.cuda.CUDAGraph"),
            (lambda: torch.cuda.cudart(), "torch.cuda.cudart"),
        ],
    )
    def test_what_has_no_stand_in_is_named(self, what, named):
        with pytest.raises(MissingShim, match=named):
            what()

    def test_cuda_extensions_cannot_be_built(self):
        extension = pytest.importorskip("torch.utils.cpp_extension")
        with pytest.raises(MissingShim, match=r"torch.utils.cpp_extension.load.*my_kernel"):
            extension.load("my_kernel", ["kernel.cu"])

    def test_it_is_an_import_error_too(self):
        assert issubclass(MissingShim, ImportError)


def test_everything_is_put_back():
    before = {name: value for name, value in vars(torch.cuda).items()}
    with redirect():
        pass
    assert {name: value for name, value in vars(torch.cuda).items()} == before
