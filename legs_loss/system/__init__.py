"""Files, locks, processes, signals, the terminal, installed packages: the interface to the machine.

The modules are independent of images and losses, and do not import torch. ``executors`` is imported by its name.
"""

from __future__ import annotations

from legs_loss.system.children import Child
from legs_loss.system.ctrl_c import held_back, noted
from legs_loss.system.distributed import is_first_process
from legs_loss.system.files import open_regular, read_regular, write_whole
from legs_loss.system.locks import FileLock, HeldError, is_held
from legs_loss.system.memory import keep_freed_memory
from legs_loss.system.plugins import plugins
from legs_loss.system.processors import cores
from legs_loss.system.terminal import never_fail_to_print, printable, say, say_error

__all__ = [
    "Child",
    "FileLock",
    "HeldError",
    "cores",
    "held_back",
    "is_first_process",
    "is_held",
    "keep_freed_memory",
    "never_fail_to_print",
    "noted",
    "open_regular",
    "plugins",
    "printable",
    "read_regular",
    "say",
    "say_error",
    "write_whole",
]
