"""A replacement of `nvidia-smi` for scripts that look for a free GPU: it reports one with unused memory.

As a program it needs only the standard library. `offer` puts it on PATH where there is no other.
"""

from __future__ import annotations

import atexit
import os
import shlex
import shutil
import sys
import tempfile
from pathlib import Path
from typing import List, Sequence

__all__ = ["answer", "memory", "offer"]


def memory() -> int:
    """Return the machine's memory in bytes, as the memory of this GPU."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return 8 << 30


def answer(arguments: Sequence[str]) -> str:
    """Return what nvidia-smi prints for ``-q -d MEMORY``, or for ``--query-gpu=FIELDS --format=csv[,...]``.

    Raises:
        KeyError: for any other query.
    """
    total = memory() >> 20
    if [word.lower() for word in arguments] == ["-q", "-d", "memory"]:
        used = {"Total": total, "Reserved": 0, "Used": 0, "Free": total}
        lines = ["==============NVSMI LOG==============", "", f"{'Attached GPUs':<42}: 1", "GPU 00000000:00:00.0"]
        return "\n".join([*lines, "    FB Memory Usage", *(f"        {k:<34}: {v} MiB" for k, v in used.items())])
    options = dict(word.partition("=")[::2] for word in arguments)
    fields, form = options.pop("--query-gpu").split(","), options.pop("--format").split(",")
    if options or form[0] != "csv" or not set(form[1:]) <= {"noheader", "nounits"}:
        raise KeyError(" ".join(arguments))
    values = {
        "count": ("1", ""),
        "index": ("0", ""),
        "name": ("CPU", ""),
        "memory.total": (str(total), "MiB"),
        "memory.used": ("0", "MiB"),
        "memory.free": (str(total), "MiB"),
        "utilization.gpu": ("0", "%"),
        "utilization.memory": ("0", "%"),
    }
    found = [(field.strip(), *values[field.strip()]) for field in fields]
    rows: List[str] = []
    if "noheader" not in form:
        rows.append(", ".join(f"{field} [{unit}]" if unit else field for field, _, unit in found))
    bare = "nounits" in form
    rows.append(", ".join(value if bare or not unit else f"{value} {unit}" for _, value, unit in found))
    return "\n".join(rows)


def offer() -> None:
    """Put this program on PATH, for this process's children, until it ends; unless there is a real one."""
    if os.name != "posix" or shutil.which("nvidia-smi"):
        return
    folder = tempfile.mkdtemp(prefix="legs-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    program = Path(folder, "nvidia-smi")
    program.write_text(
        f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -I {shlex.quote(os.path.abspath(__file__))} "$@"\n'
    )
    program.chmod(0o755)
    os.environ["PATH"] = os.environ.get("PATH", os.defpath) + os.pathsep + folder


if __name__ == "__main__":
    try:
        print(answer(sys.argv[1:]))
    except KeyError:
        sys.exit(f"legs: error: nvidia-smi {' '.join(sys.argv[1:])} has no shim on the CPU")
