"""A replacement of `nvidia-smi` for scripts that look for a free GPU: it reports one with unused memory.

As a program it needs only the standard library. `offer` puts `bin/nvidia-smi`, which runs it, on PATH, where it
is found if there is no other.
"""

from __future__ import annotations

import os
import sys
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
    """Put this program last on PATH, and the Python that runs it, for this process's children."""
    folders = (os.path.join(os.path.dirname(os.path.abspath(__file__)), "bin"), os.path.dirname(sys.executable))
    os.environ["PATH"] = os.pathsep.join([os.environ.get("PATH", os.defpath), *folders])


if __name__ == "__main__":
    try:
        print(answer(sys.argv[1:]))
    except KeyError:
        sys.exit(f"legs: error: nvidia-smi {' '.join(sys.argv[1:])} has no shim on the CPU")
