"""Run a training script with the LEGS loss, its files untouched: legs-patch's edits are made while Python imports.

    legs run train.py -s scene/
    torchrun --nproc_per_node 2 -m legs_loss run train.py -s scene/

Every line keeps its number, so that tracebacks point at the right lines.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Sequence

from legs_adapters.code.folders import SUBMODULE, VENDORED, foreign_folder
from legs_adapters.code.sources import check_root
from legs_adapters.plan import plan
from legs_adapters.rewritten import execute
from legs_adapters.terms.instead import offered, trained_instead
from legs_adapters.unsearched import unread
from legs_loss import LegsError
from legs_loss.config import find_config
from legs_loss.system.terminal import is_first_process, say


def checkout_of(script: Path) -> Path:
    """Return the folder that is searched for a script: its git checkout's root, or its own folder.

    For a script of vendored code, under third_party for example, it is the root of that code.
    """
    folder = script.resolve().parent
    for candidate in (folder, *folder.parents):
        if (candidate / ".git").exists() or (candidate / ".legs-patch.json").exists():
            foreign = foreign_folder(candidate, script.resolve().relative_to(candidate).as_posix())
            if foreign is not None and foreign.why in (VENDORED, SUBMODULE):
                return candidate / foreign.path
            return candidate
    return folder


def run_script(
    script: str | os.PathLike[str], arguments: Sequence[str], cpu: bool = False, ssim: bool = False, masks: bool = False
) -> int:
    """Run a script as ``python script arguments`` does, with the LEGS loss in it.

    Args:
        script: the script.
        arguments: its arguments.
        cpu: run it without a GPU: CUDA calls run on the CPU, and a shim replaces its rasterizer.
        ssim: let legs_loss.ssim compute the training step's SSIM where that is 3DGS's.
        masks: hide masked pixels from every other term of the step.

    Returns:
        The exit code, where the script does not leave by ``sys.exit`` (which goes on as it is).

    Raises:
        LegsError: there is no such script; or an option of ours is among its arguments, and it does not know it (what
            stands behind the script is the script's own); or a setting is wrong; or its codebase has only terms that
            cannot be decided, or, unless ``cpu``, none; or, with ``cpu``, the script uses a CUDA feature that has no
            shim.
    """
    path = Path(script)
    if not path.is_file():
        raise LegsError(f"{script} is not a file: give the training script")
    for option in ("--cpu", "--ssim", "--masks"):
        if option in arguments and option[2:].encode() not in path.read_bytes():
            raise LegsError(f"{option} stands behind {script}, which does not know it: legs run {option} {script} ...")
    find_config(path, argv=[])  # report wrong settings now, not at the first training step
    root = check_root(checkout_of(path))
    found = plan(root, in_place=True, ssim=ssim, masks=masks)
    for elsewhere in found.unsearched:
        _say(f"not weighted: {elsewhere.text(root)}")
    is_plain = not found.after and not found.findings.patched
    instead = list(trained_instead(root, (), found.findings))
    quoted = (*found.findings.problems, *found.findings.doubts)
    said = [f"{each.path}:{each.line}: {each.reason}; if this is the loss: {each.way}" for each in quoted]
    if is_plain and found.findings.problems:
        raise LegsError(*said, *instead)
    for text in said if is_plain else (*said, *instead):
        _say(f"not weighted: {text}")
    if is_plain:
        what = offered(found.findings, f"legs-patch {root} ") + unread(root, (), found.findings)
        none = f"no photometric L1 term was found in {root}: {what}"
        if not cpu:
            raise LegsError(none, *instead)
        for text in (f"nothing is weighted: {none}", *instead):
            _say(text)
    sources = {os.path.realpath(str(root / name)): data for name, data in found.after.items()}
    for site in found.findings.sites:
        _say(f"{site.path}:{site.line} {site.form.done} in this run")
    for use, _ in found.findings.unweighted:
        _say(f"{use.left.path}:{use.left.line} is not weighted in this run")
    return execute([str(script), *arguments], sources, root if cpu else None)


def _say(message: str) -> None:
    """Print a line on stderr, in the first of the processes that torchrun starts."""
    if is_first_process():
        say(f"legs-loss: {message}", sys.stderr)
