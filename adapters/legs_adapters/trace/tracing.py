"""Trace a command in its checkout: run it with torch's differences watched, and read what was seen."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Optional

from legs_adapters.terms.traced import Trace, Traced
from legs_adapters.trace.child import run_watched, work_folder
from legs_adapters.trace.command import SCENE, Command, filled, folders
from legs_loss import LegsError
from legs_loss.system.terminal import say


def trace(root: Path, text: str, steps: int, cpu: bool = False, photos: Optional[str] = None) -> Trace:
    """Run a command in a checkout until that many steps were seen, and return what it compared.

    Args:
        root: the checkout, in which the command runs.
        text: the script and its arguments; `python` or a launcher like `torchrun` may stand before it.
        steps: of an optimiser that moves what is rendered.
        cpu: run it with the shims; where it names no folder that is there, on the embedded scene.
        photos: the folder of the photographs; default: those that the scenes' models list.

    Raises:
        SystemExit: the script failed, with its exit code; its traceback is on stderr already.
        LegsError: the command names no script; or nothing was trained.
    """
    command = Command.parse(root, text)
    if steps < 1:
        raise LegsError(f"--steps must be at least 1, got {steps}")
    if photos is not None and not os.path.isdir(photos):
        raise LegsError(f"--photos {photos}: there is no such folder")
    script = command.script
    with work_folder("legs-trace-") as work:
        if cpu:
            from legs_adapters.shims.packages import check_imports
            from legs_loss.lab.embedded import write_embedded_scene

            check_imports(root, script)
            if not folders(root, command.arguments):
                places = {"scene": write_embedded_scene(work / "scene", **SCENE), "output": work / "output"}
                more = filled(root / script, None, command.arguments, 10 * steps, **places)
                command = command._replace(arguments=[*command.arguments, *more])
        say(f"legs-patch: {steps} steps of {script} as it is, in {root}; it writes where it always does", sys.stderr)
        seen = run_watched(root, work, command, steps, cpu, photos)
    if seen.code and not seen.is_over:  # (a rank that waits for one that has ended fails)
        message = f"{script} ended with exit code {seen.code}; nothing was changed. By reading: legs-patch {root}"
        say(f"legs-patch: error: {message}", sys.stderr)
        sys.exit(seen.code if seen.code > 0 else 128 - seen.code)
    if seen.failure:
        say(f"legs-patch: warning: a difference could not be watched ({seen.failure})", sys.stderr)
    kernels = ", ".join(seen.unseen)
    unseen = [f"a trace cannot look into fused kernels, as these under the loss: {kernels}"] if kernels else []
    terms = list(Traced.read(seen.terms))
    if not terms:
        passes = f"{seen.backward_passes or 'no'} backward passes seen"
        message = f"{script} ended before an optimiser moved what it renders ({passes}): by reading: legs-patch {root}"
        raise LegsError(message, *unseen)
    for line in unseen if not any(term.is_photometric for term in terms) else ():
        say(f"legs-patch: warning: {line}", sys.stderr)
    return Trace(terms, frozenset((path, name) for path, name in seen.scripted))
