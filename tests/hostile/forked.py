"""A command in a forked process, which can act on itself at any of its lines or operations."""

from __future__ import annotations

import os
import signal
import sys
import traceback
from typing import Callable, Tuple


def forked(command: Callable[[], int]) -> Tuple[int, str]:
    """Run a function in a forked process that Ctrl-C interrupts; return its wait status and what it printed.

    What the function returns is the exit code; an error is printed, and the code 99.
    """
    words, written = os.pipe()
    child = os.fork()
    if child == 0:
        os.dup2(written, 1)
        os.dup2(written, 2)
        sys.stdout, sys.stderr = os.fdopen(1, "w", closefd=False), os.fdopen(2, "w", closefd=False)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        code = 99
        try:
            code = command()
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)
    os.close(written)
    with os.fdopen(words, errors="replace") as file:
        said = file.read()
    return os.waitpid(child, 0)[1], said
