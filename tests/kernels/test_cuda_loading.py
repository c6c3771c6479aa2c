"""Finding, compiling, keeping and loading the CUDA kernels, with stand-ins for the libraries."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from legs_loss.kernels.contract import NotNow
from legs_loss.kernels.cuda import nvrtc
from legs_loss.kernels.cuda.modules import PLAIN, BinaryCache, Modules, Variant, cache_folder
from legs_loss.kernels.cuda.nvrtc import Compiler, CompilerError, NotFound, candidates, find_compiler
from tests.kernels.parts import FakeCompiler, FakeDriver


class TestCache:
    def test_what_is_kept_is_found_again(self, tmp_path):
        cache = BinaryCache(tmp_path / "a" / "b")
        assert cache.get(b"key") is None
        cache.put(b"key", b"binary")
        assert cache.get(b"key") == b"binary" and cache.get(b"other") is None
        assert len(list(cache.folder.iterdir())) == 1  # no temporary file is left

    @pytest.mark.parametrize(
        "damage", [lambda c: c[:-1], lambda c: b"", lambda c: c[:40] + b"x" + c[41:], lambda c: b"x" * 9]
    )
    def test_a_damaged_file_is_compiled_again(self, tmp_path, damage):
        for _ in range(2):
            compiler = FakeCompiler()
            modules = Modules(FakeDriver(), compiler, BinaryCache(tmp_path))
            modules.function("legs_scale", PLAIN)
            assert len(compiler.calls) == 1
            (file,) = tmp_path.iterdir()
            file.write_bytes(damage(file.read_bytes()))

    def test_a_file_under_another_key_is_not_taken(self, tmp_path):
        cache = BinaryCache(tmp_path)
        cache.put(b"one", b"binary")
        (file,) = tmp_path.iterdir()
        cache.put(b"two", b"other")
        (second,) = set(tmp_path.iterdir()) - {file}
        os.replace(str(file), str(second))
        assert cache.get(b"two") is None

    def test_a_folder_that_cannot_be_made_is_no_error(self, tmp_path):
        (tmp_path / "file").write_text("")
        cache = BinaryCache(tmp_path / "file" / "kernels")
        cache.put(b"key", b"binary")
        assert cache.get(b"key") is None

    def test_where_it_lies(self, tmp_path):
        assert cache_folder({"XDG_CACHE_HOME": str(tmp_path)}, "linux") == tmp_path / "legs-loss" / "kernels"
        assert cache_folder({"XDG_CACHE_HOME": "relative"}, "linux") == Path.home() / ".cache" / "legs-loss" / "kernels"
        assert cache_folder({"LOCALAPPDATA": str(tmp_path)}, "win32") == tmp_path / "legs-loss" / "kernels"

    def test_a_user_without_a_home_compiles_each_time(self, monkeypatch):
        def homeless():
            raise RuntimeError("Could not determine home directory.")

        monkeypatch.setattr(Path, "home", homeless)
        assert cache_folder({}, "linux") is None
        compiler = FakeCompiler()
        for _ in range(2):
            Modules(FakeDriver(), compiler, BinaryCache(None)).function("legs_scale", PLAIN)
        assert len(compiler.calls) == 2

    def test_two_processes_compile_at_once(self, tmp_path):
        """Each writes a file of its own and puts it in place in one step: whoever comes second finds a whole one."""
        writers = [BinaryCache(tmp_path) for _ in range(2)]
        first, second = os.replace, []

        def meanwhile(*paths):
            if not second:
                second.append(True)
                writers[1].put(b"key", b"binary")
            return first(*paths)

        with pytest.MonkeyPatch.context() as patched:
            patched.setattr(os, "replace", meanwhile)
            writers[0].put(b"key", b"binary")
        assert writers[0].get(b"key") == b"binary" and len(list(tmp_path.iterdir())) == 1


class TestModules:
    def test_a_variant_is_compiled_and_loaded_once(self, parts, tmp_path):
        driver, compiler, modules = parts
        for _ in range(2):
            for name in ("legs_scale", "legs_finish"):
                modules.function(name, PLAIN)
        assert len(compiler.calls) == len(driver.loads) == 1
        assert compiler.calls[0][1] == "sm_90" and "-DVALUE=0" in compiler.calls[0][0]
        modules.function("legs_range", Variant(1, 3, 2))
        assert {"-DVALUE=1", "-DSTENCIL=3", "-DNORM=2"} <= set(compiler.calls[1][0])

    def test_another_process_takes_it_from_the_disk(self, parts, tmp_path):
        parts[2].function("legs_scale", PLAIN)
        compiler, driver = FakeCompiler(), FakeDriver()
        Modules(driver, compiler, BinaryCache(tmp_path / "kernels")).function("legs_scale", PLAIN)
        assert not compiler.calls and driver.loads == parts[0].loads

    @pytest.mark.parametrize("change", ["compiler", "gpu", "source"])
    def test_another_compiler_gpu_or_source_is_compiled_for(self, parts, tmp_path, monkeypatch, change):
        parts[2].function("legs_scale", PLAIN)
        compiler, driver = FakeCompiler(), FakeDriver()
        if change == "compiler":
            compiler.version = "13.0"
        elif change == "gpu":
            driver.architecture = 86
        else:
            monkeypatch.setattr("legs_loss.kernels.cuda.modules.source", lambda: b"other")
        Modules(driver, compiler, BinaryCache(tmp_path / "kernels")).function("legs_scale", PLAIN)
        assert len(compiler.calls) == 1

    def test_nothing_is_loaded_during_a_capture(self, parts):
        driver, compiler, modules = parts
        modules.function("legs_scale", PLAIN)
        driver.captures = True
        modules.function("legs_scale", PLAIN)
        with pytest.raises(NotNow):
            modules.function("legs_scale", Variant(1))
        assert len(compiler.calls) == 1


class TestFindingNvrtc:
    def files(self, root, *names):
        for name in names:
            path = root / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(b"")

    def found(self, root, major, platform="linux"):
        folders = [root / "torch" / "lib", root]
        return [path.relative_to(root).as_posix() for path in candidates(folders, major, platform)]

    def test_torch_with_cuda_11_brings_it_in_its_own_folder(self, tmp_path):
        self.files(tmp_path, "torch/lib/libnvrtc-1ea278b5.so.11.2", "torch/lib/libnvrtc-builtins.so.11.3")
        assert self.found(tmp_path, "11") == ["torch/lib/libnvrtc-1ea278b5.so.11.2"]

    def test_torch_with_cuda_12_and_13_requires_packages_named_nvidia(self, tmp_path):
        twelve, thirteen = "nvidia/cuda_nvrtc/lib/libnvrtc.so.12", "nvidia/cu13/lib/libnvrtc.so.13"
        self.files(tmp_path, twelve, thirteen, "nvidia/cuda_nvrtc/lib/libnvrtc.alt.so.12")
        self.files(tmp_path, "nvidia/cuda_nvrtc/lib/libnvrtc-builtins.so.12.9", "nvidia/cublas/lib/libcublas.so.12")
        assert self.found(tmp_path, "12") == [twelve]
        assert self.found(tmp_path, "13") == [thirteen]

    def test_windows(self, tmp_path):
        self.files(tmp_path, "torch/lib/nvrtc64_120_0.dll", "torch/lib/nvrtc64_120_0.alt.dll")
        self.files(tmp_path, "torch/lib/nvrtc64_112_0.dll", "torch/lib/nvrtc-builtins64_121.dll")
        assert self.found(tmp_path, "12", "win32") == ["torch/lib/nvrtc64_120_0.dll"]
        assert self.found(tmp_path, "11", "win32") == ["torch/lib/nvrtc64_112_0.dll"]
        self.files(tmp_path, "nvidia/cu13/bin/x86_64/nvrtc64_130_0.dll", "nvidia/cuda_nvrtc/bin/nvrtc64_120_0.dll")
        assert self.found(tmp_path, "13", "win32") == ["nvidia/cu13/bin/x86_64/nvrtc64_130_0.dll"]
        assert self.found(tmp_path, "12", "win32")[1:] == ["nvidia/cuda_nvrtc/bin/nvrtc64_120_0.dll"]

    @pytest.mark.parametrize(
        ("platform", "names"),
        [
            ("linux", ["libnvrtc.so.11.2", "libnvrtc.so.12", "libnvrtc.so.13"]),
            ("win32", ["nvrtc64_112_0.dll", "nvrtc64_120_0.dll", "nvrtc64_130_0.dll"]),
        ],
    )
    def test_the_name_that_the_system_looks_for(self, platform, names):
        assert [nvrtc._plain_name(major, platform) for major in ("11", "12", "13")] == names

    def test_nothing_there(self, tmp_path, monkeypatch):
        def refuse(name):
            raise OSError(f"{name}: cannot open shared object file")

        monkeypatch.setattr(nvrtc.ctypes, "CDLL", refuse)
        with pytest.raises(NotFound, match=r"no NVRTC of CUDA 12.4 was found: libnvrtc.so.12: cannot open"):
            find_compiler([tmp_path], "12.4")

    def test_its_builtins_are_loaded_first(self, tmp_path, monkeypatch):
        self.files(tmp_path, "lib/libnvrtc.so.12", "lib/libnvrtc-builtins.so.12.9")
        loaded = []
        monkeypatch.setattr(nvrtc.ctypes, "CDLL", lambda name: loaded.append(Path(name).name) or FakeNvrtc())
        assert find_compiler([tmp_path / "lib"], "12.9").version == "12.9"
        assert loaded == ["libnvrtc-builtins.so.12.9", "libnvrtc.so.12"]


class FakeNvrtc:
    """The library, for GPUs 75 to 90; a source that says "bad" does not compile."""

    def __init__(self):
        self.nvrtcGetErrorString = lambda code: b"NVRTC_ERROR_COMPILATION"  # a function, so that restype can be set
        self.destroyed = 0

    def nvrtcVersion(self, major, minor):
        major._obj.value, minor._obj.value = 12, 9
        return 0

    def nvrtcGetNumSupportedArchs(self, count):
        count._obj.value = 3
        return 0

    def nvrtcGetSupportedArchs(self, numbers):
        numbers[:] = [75, 80, 90]
        return 0

    def nvrtcCreateProgram(self, program, source, *rest):
        self.source = source
        return 0

    def nvrtcCompileProgram(self, program, count, options):
        self.options = [option.decode() for option in options]
        return 6 if b"bad" in self.source else 0

    def nvrtcDestroyProgram(self, program):
        self.destroyed += 1
        return 0

    def __getattr__(self, name):
        text = {"ProgramLog": b"note\nlegs.cu(3): error: bad\n\0", "CUBIN": b"\x7fELF", "PTX": b".version"}
        what = name[len("nvrtcGet") :]
        if what.endswith("Size"):
            return lambda program, size: setattr(size._obj, "value", len(text[what[:-4]])) or 0
        return lambda program, buffer: setattr(buffer, "raw", text[what]) or 0


class TestCompiler:
    def test_machine_code_for_a_known_gpu_and_ptx_for_a_newer_one(self):
        library = FakeNvrtc()
        compiler = Compiler(library)
        assert compiler.target(80) == "sm_80" and compiler.target(86) == "compute_80"
        assert compiler.target(120) == "compute_90"
        assert compiler.compile(b"good", ["-DVALUE=0"], "sm_80")[0] == b"\x7fELF"
        assert library.options == ["--gpu-architecture=sm_80", "-DVALUE=0"]
        assert compiler.compile(b"good", [], "compute_90")[0] == b".version"
        with pytest.raises(CompilerError, match=r"NVRTC 12.9 does not compile for sm_50"):
            compiler.target(50)

    def test_an_error_is_the_logs_first(self):
        library = FakeNvrtc()
        with pytest.raises(CompilerError, match=r"legs.cu\(3\): error: bad"):
            Compiler(library).compile(b"bad", [], "sm_80")
        assert library.destroyed == 1
