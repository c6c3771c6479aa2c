"""Run a script as Python does, with rewritten sources in place of files on disk: here, and in processes it spawns."""

from __future__ import annotations

import atexit
import builtins
import importlib.machinery
import importlib.util
import linecache
import multiprocessing.spawn
import os
import runpy
import signal
import sys
import threading
import types
from pathlib import Path
from typing import Any, Callable, Dict, Optional, Sequence, Tuple, Type

_BEFORE_THE_SCRIPT = (__name__, "importlib", "_frozen_importlib")  # modules that load it


def execute(words: Sequence[str], sources: Dict[str, bytes], cpu_root: Optional[Path] = None) -> int:
    """Run a script as the main program of this process, with other text for the files that ``sources`` names.

    Args:
        words: the script and its arguments, as they would be given to python; or `-m`, a module and its arguments.
        sources: by real path, what to run in place of what is on disk.
        cpu_root: the codebase, if its CUDA calls are to run on the CPU.

    Returns:
        The exit code, where the script does not leave by ``sys.exit``.
    """
    install(sources)
    passed_on: Tuple[Type[BaseException], ...] = (SystemExit,)
    if cpu_root is not None:
        from legs_adapters.shims import MissingShim, start

        start(cpu_root)
        passed_on += (MissingShim,)
    is_module = words[0] == "-m"
    sys.argv[:] = words[is_module:]
    if not getattr(sys.flags, "safe_path", False):  # else Python puts no folder there
        sys.path[0] = os.getcwd() if is_module else os.path.dirname(os.path.realpath(words[0]))
    try:
        if is_module:
            runpy.run_module(words[1], run_name="__main__", alter_sys=True)
        else:
            _run_main(_as_python_names(words[0]), "__main__", "__mp_main__")  # what spawned processes send is of both
    except passed_on:
        raise
    except BaseException as error:
        traceback = error.__traceback__  # from the script on; of a syntax error in it none
        while traceback is not None and traceback.tb_frame.f_globals["__name__"].startswith(_BEFORE_THE_SCRIPT):
            traceback = traceback.tb_next
        sys.excepthook(type(error), error.with_traceback(traceback), traceback)
        return _interrupted() if isinstance(error, KeyboardInterrupt) else 1
    return 0


def _as_python_names(script: str) -> str:
    """Return a script's `__file__`, as tracebacks have it: since 3.9 absolute, with `..` left as it is on POSIX."""
    if sys.version_info < (3, 9):
        return script
    return os.path.join(os.getcwd(), script) if os.name == "posix" else os.path.abspath(script)


def run_exit_functions() -> None:
    """Do what Python does at its end, which a signal and `os._exit` leave out."""
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()


def _interrupted() -> int:
    """End as Python does on Ctrl-C: by the signal, so that a shell's loop ends too; before 3.8 with exit code 1.

    First threads end and exit functions run, since a signal gives them no time.
    """
    if sys.version_info < (3, 8):
        return 1
    if os.name == "posix":
        threading._shutdown()  # type: ignore[attr-defined]
        run_exit_functions()
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGINT)
    return 130


def install(sources: Dict[str, bytes]) -> None:
    """Import these sources, by real path, in place of the files on disk.

    A process that is spawned (`torch.multiprocessing.spawn`, DataLoader workers) starts as a new Python, which imports
    the script again: it installs the same sources before.
    """
    loader: Any = importlib.machinery.SourceFileLoader
    spawn: Any = multiprocessing.spawn
    read, stats = loader.get_data, loader.path_stats

    def get_data(self: Any, path: str) -> bytes:
        data = sources.get(os.path.realpath(path))
        if data is None:
            return read(self, path)
        text = importlib.util.decode_source(data)
        # Without a time of last change, linecache does not look at the disk again.
        linecache.cache[path] = (len(text), None, text.splitlines(keepends=True), path)
        vars(builtins)["legs_loss"] = importlib.import_module("legs_loss")  # the name in the text has no import
        return data

    def path_stats(self: Any, path: str) -> Any:
        if os.path.realpath(path) in sources:
            raise OSError  # no bytecode of it is read or written
        return stats(self, path)

    def import_main(path: str) -> None:  # as multiprocessing does, which reads the file
        if getattr(sys.modules["__main__"], "__file__", None) != path:
            spawn.old_main_modules.append(sys.modules["__main__"])
            _run_main(path, "__mp_main__", "__main__")

    loader.get_data, loader.path_stats = get_data, path_stats
    spawn._fixup_main_from_path = import_main
    call_when_spawned(install, sources)


def call_when_spawned(function: Callable[[Any], None], argument: Any) -> None:
    """Let each process that this one spawns call a module's function before it does anything else."""
    spawn: Any = multiprocessing.spawn
    prepare = spawn.get_preparation_data
    spawn.get_preparation_data = lambda name: {**prepare(name), f"legs {function.__name__}": _Call(function, argument)}


class _Call:
    """A call that is made where this is unpickled."""

    def __init__(self, function: Callable[[Any], None], argument: Any) -> None:
        self._call = function, (argument,)

    def __reduce__(self) -> Any:
        return self._call


def _run_main(script: str, *names: str) -> None:
    """Run a file as the main module, with the attributes that Python gives it, under these names."""
    main = types.ModuleType(names[0])
    main.__loader__ = loader = importlib.machinery.SourceFileLoader(names[0], script)
    main.__dict__.update(__file__=script, __builtins__=builtins, __cached__=None, __annotations__={})
    sys.modules.update(dict.fromkeys(names, main))
    exec(compile(loader.get_data(script), script, "exec", dont_inherit=True), main.__dict__)
