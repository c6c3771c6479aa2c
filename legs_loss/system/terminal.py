"""Print safely, from one rank: names and lines of foreign files can contain terminal control sequences."""

from __future__ import annotations

import os
import re
import sys
from typing import Any, Optional, TextIO

# Control characters but tab and the end of a line; the marks that turn the direction of text, and halves of characters.
_OBEYED = re.compile("(?!\r\n)[\0-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")


def printable(text: str, lines: bool = False) -> str:
    r"""Return a text with control sequences and unencodable characters escaped.

    Args:
        text: what is to be printed.
        lines: whether it has several lines; else a line feed is escaped, since it could look like a line of a report.

    Examples:
        >>> print(printable("train\x1b[2J\nall is well.py"))
        train\x1b[2J\nall is well.py
    """
    shown = _OBEYED.sub(lambda found: ascii(found.group())[1:-1], text)
    return shown if lines else shown.replace("\r\n", "\\r\\n").replace("\n", "\\n")


def say(text: object, stream: Optional[TextIO] = None, end: str = "\n", lines: bool = False) -> None:
    """Print to stdout, or another stream, after :func:`printable`, and flush."""
    print(printable(str(text), lines), file=stream, end=end, flush=True)


def progress(total: int, what: str) -> Any:
    """Return a tqdm that says on a terminal's stderr, after two seconds, how many of some things are done."""
    from tqdm import tqdm

    shown = "{n:.0f} of {total} " + what + ", {elapsed}"
    return tqdm(total=total, bar_format=shown, delay=2, leave=False, disable=not (sys.stderr and sys.stderr.isatty()))


_was_first = True  # by the process group, which a script may have left when its process ends


def is_first_process() -> bool:
    """Return whether this process is rank 0 of its run, or the run's only one.

    The process group says so once it is initialised; before that, RANK as torchrun and Slurm's wrappers set it. torch
    is not imported for it.

    >>> is_first_process()
    True
    """
    global _was_first
    distributed = sys.modules.get("torch.distributed")
    if distributed is not None and distributed.is_available() and distributed.is_initialized():
        _was_first = distributed.get_rank() == 0
        return _was_first
    return _was_first and not os.environ.get("RANK", "").strip("0").isdigit()
