"""Files, locks, processes, signals, the terminal, installed packages: the interface to the machine.

The modules are independent of images and losses, and do not import torch. A name is imported on first use: a training
step needs few. No module has the name of what it publishes.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from legs_loss.system.ctrl_c import held_back as held_back
    from legs_loss.system.ctrl_c import noted as noted
    from legs_loss.system.entry_points import plugins as plugins
    from legs_loss.system.files import open_regular as open_regular
    from legs_loss.system.files import read_regular as read_regular
    from legs_loss.system.files import read_text as read_text
    from legs_loss.system.files import write_whole as write_whole
    from legs_loss.system.locks import FileLock as FileLock
    from legs_loss.system.locks import HeldError as HeldError
    from legs_loss.system.locks import is_held as is_held
    from legs_loss.system.machine import cores as cores
    from legs_loss.system.terminal import is_first_process as is_first_process
    from legs_loss.system.terminal import never_fail_to_print as never_fail_to_print
    from legs_loss.system.terminal import printable as printable
    from legs_loss.system.terminal import progress as progress
    from legs_loss.system.terminal import say as say
    from legs_loss.system.terminal import say_error as say_error

_NAMES = {
    "ctrl_c": ["held_back", "noted"],
    "files": ["open_regular", "read_regular", "read_text", "write_whole"],
    "locks": ["FileLock", "HeldError", "is_held"],
    "machine": ["cores"],
    "entry_points": ["plugins"],
    "terminal": ["is_first_process", "never_fail_to_print", "printable", "progress", "say", "say_error"],
}
_HOMES = {name: module for module, names in _NAMES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    return value
