"""Processes of commands that begin with torch imported, which a fork gives in no time.

A server that has imported others' packages, and nothing of ours, forks for each command. The new process has arguments,
environment, folder, output and an exit code of its own, imports our code itself, and ends as any other, up to where
Python would take its modules apart: that of the server's copies takes a quarter of a second.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import importlib
import json
import os
import runpy
import select
import signal
import subprocess
import sys
import tempfile
import threading
import types
import weakref

PATH = os.pathsep.join(path for path in sys.path if path)
# torch's compiler is what building an optimiser imports.
PACKAGES = (
    "torch",
    "torch._dynamo",
    "numpy",
    "PIL.Image",
    "PIL.PngImagePlugin",
    "numba",
    "matplotlib.figure",
)


def run(command, *, env, cwd=None, timeout=300, text=True, check=False):
    """Do as ``subprocess.run`` with captured output, for this Python with ``-m MODULE``, ``-c CODE`` or a script.

    Where other packages are to be imported than here (PYTHONPATH), the process begins with none.
    """
    if not hasattr(os, "fork") or env.get("PYTHONPATH") != PATH:
        return subprocess.run(command, capture_output=True, env=env, cwd=cwd, timeout=timeout, text=text, check=check)
    assert command[0] == sys.executable
    with tempfile.NamedTemporaryFile() as out, tempfile.NamedTemporaryFile() as err:
        job = {"arguments": command[1:], "env": env, "cwd": str(cwd or os.getcwd()), "out": out.name, "err": err.name}
        status = _ask(job, timeout)
        printed, said = out.read(), err.read()
    code = -os.WTERMSIG(status) if os.WIFSIGNALED(status) else os.WEXITSTATUS(status)
    if text:
        printed, said = (b.decode(errors="surrogateescape").replace("\r\n", "\n") for b in (printed, said))
    done = subprocess.CompletedProcess(command, code, printed, said)
    if check:
        done.check_returncode()
    return done


_server = None


def _ask(job, timeout):
    """Return the wait status of a job's process, which is killed if it takes more than ``timeout`` seconds."""
    global _server
    if _server is None:
        _server = subprocess.Popen(
            [sys.executable, __file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=dict(os.environ, OMP_NUM_THREADS="1", PYTHONPATH=PATH),
            bufsize=0,
        )
        atexit.register(_end)
    _server.stdin.write(json.dumps(job).encode() + b"\n")
    process = int(_server.stdout.readline())
    if not select.select([_server.stdout], [], [], timeout)[0]:
        os.kill(process, signal.SIGKILL)
        _server.stdout.readline()
        raise subprocess.TimeoutExpired(job["arguments"], timeout)
    return int(_server.stdout.readline())


def _end():
    """End the server, and wait for it: then its processes' time counts to this one's."""
    _server.kill()
    _server.wait()


def _serve():
    """Fork for each line of stdin; return its job in the new process, and None when stdin ends."""
    for line in sys.stdin:
        process = os.fork()
        if process == 0:
            return json.loads(line)
        print(process, flush=True)
        print(os.waitpid(process, 0)[1], flush=True)
    return None


def abs_of(value):
    """Return the absolute value."""
    return abs(value)


def _become(job):
    """Make this process that of the job: what a new Python would read at its start is read again."""
    opened = [os.open(os.devnull, os.O_RDONLY), *(os.open(job[to], os.O_WRONLY) for to in ("out", "err"))]
    for descriptor, file in enumerate(opened):
        os.dup2(file, descriptor)
        os.close(file)
    os.environ.clear()
    os.environ.update(job["env"])
    os.chdir(job["cwd"])
    encoding, _, errors = job["env"].get("PYTHONIOENCODING", "utf-8").partition(":")
    sys.stdin = os.fdopen(0, closefd=False)
    sys.stdout = os.fdopen(1, "w", encoding=encoding, errors=errors or "strict", closefd=False)
    sys.stderr = os.fdopen(2, "w", encoding=encoding, errors="backslashreplace", closefd=False, buffering=1)
    sys.path[:] = [path for path in sys.path if path != os.path.dirname(os.path.abspath(__file__))]
    first, *rest = job["arguments"]
    if first == "-m":
        sys.path.insert(0, job["cwd"])
        sys.argv = rest
        runpy.run_module(rest[0], run_name="__main__", alter_sys=True)
    elif first == "-c":
        sys.path.insert(0, "")
        sys.argv = ["-c", *rest[1:]]
        sys.modules["__main__"] = main = types.ModuleType("__main__")
        exec(compile(rest[0], "<string>", "exec"), main.__dict__)
    else:
        sys.path.insert(0, os.path.dirname(os.path.abspath(first)))
        sys.argv = job["arguments"]
        runpy.run_path(first, run_name="__main__")


def _leave(code):
    """End this process as Python does: threads are waited for, what is to be done at the exit is, output is flushed."""
    if not isinstance(code, int):
        sys.exit(code)  # a message, which Python prints
    threading._shutdown()
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        if not stream.closed:
            stream.flush()
    os._exit(code & 0xFF)


if __name__ == "__main__":
    for package in PACKAGES:
        with contextlib.suppress(ImportError):
            importlib.import_module(package)
    with contextlib.suppress(ImportError):
        importlib.import_module("PIL.Image").init()  # its plugins, a file each
        importlib.import_module("numba").njit(abs_of)(1)  # numba reads what it can compile at its first function
    for finalizer in weakref.finalize._registry:  # what torch takes apart at an exit is the server's, too
        finalizer.atexit = False
    gc.freeze()  # what no collector touches at a process's end stays shared with the server
    found = _serve()
    if found is not None:
        ended = 0
        try:
            _become(found)
        except SystemExit as exit:
            ended = 0 if exit.code is None else exit.code
        _leave(ended)
