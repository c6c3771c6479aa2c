"""Start processes that work for this one, with a pipe to each."""

from __future__ import annotations

import multiprocessing
import os
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any, Callable

from legs_loss.errors import LegsError
from legs_loss.system.ctrl_c import kept_from_children


class Child:
    """A process that runs ``target(connection, *arguments)``, and this side's end of the connection.

    Raises:
        LegsError: this user may not enter the current folder (``sudo -u``).
    """

    def __init__(self, target: Callable[..., None], *arguments: Any) -> None:
        context = multiprocessing.get_context("spawn")  # forked, it would inherit locks and threads
        ours, theirs = context.Pipe()
        self.connection: Connection = ours
        self.process: BaseProcess = context.Process(target=target, args=(theirs, *arguments), daemon=True)
        if not os.access(os.curdir, os.X_OK):  # the child is started in it, by its name
            raise LegsError("the current folder is another user's, and processes cannot be started in it: leave it")
        with kept_from_children():
            self.process.start()
        theirs.close()

    def end(self, patience: float = 0.0) -> None:
        """Close the pipe, which ends the process when it is idle; after some seconds kill it."""
        self.connection.close()
        self.process.join(patience)
        self.process.terminate()
        self.process.join()
