"""The command that trains: its script, its arguments, and the folders that it names."""

from __future__ import annotations

import itertools
import os
import shlex
import socket
import sys
from pathlib import Path
from typing import List, Optional, Sequence, Tuple

from legs_loss import LegsError

SCENE = {"views": 12, "width": 96, "height": 64, "points": 800, "samples": 1}  # the embedded one
# The arguments of a script like Inria's, where its source has these words. (Inria's options are named after attributes,
# except those that train.py adds itself.)
_ARGUMENTS = (
    ("source_path", "-s {scene}"),
    ("model_path", "-m {output}"),
    ("iterations", "--iterations {iterations}"),
    ("--test_iterations", "--test_iterations {iterations}"),
    ("--port", "--port {port}"),
)


def parts(root: Path, command: str) -> Tuple[List[str], str, List[str]]:
    """Return what stands before the script (nothing for python itself), the script, and its arguments."""
    try:
        words = shlex.split(command)
    except ValueError as error:
        raise LegsError(f"--trace {command!r}: {error}") from None
    at = next((i for i, word in enumerate(words) if word.endswith(".py")), None)
    if at is None:
        raise LegsError(f'--trace {command!r} names no script: --trace "train.py -s SCENE"')
    if not (root / words[at]).is_file():
        raise LegsError(f"--trace: there is no {words[at]} in {root}")
    before = words[: at - 1 if words[at - 1 : at] == ["-m"] else at]
    variables = list(itertools.takewhile(lambda word: "=" in word, before))  # a shell's `CUDA_VISIBLE_DEVICES=0 python`
    program = before[len(variables) :]
    is_python = all(os.path.basename(word).startswith("python") or word == "-u" for word in program)
    if variables:
        return ["env", *variables, *([sys.executable] if is_python else program)], words[at], words[at + 1 :]
    return [] if is_python else before, words[at], words[at + 1 :]


def folders(root: Path, arguments: Sequence[str]) -> List[str]:
    """Return the folders that a command's words name, the outermost only; not the checkout itself, nor one of it."""
    named = [word.partition("=")[2] if word.startswith("-") else word for word in arguments]
    paths = [os.path.realpath(str(root / word)) for word in named if word]
    found = [path for path in dict.fromkeys(paths) if os.path.isdir(path) and path != os.path.realpath(str(root))]
    return [path for path in found if not any(path != other and path.startswith(other + os.sep) for other in found)]


def filled(script: Path, text: Optional[str], given: Sequence[str], iterations: int, **places: Path) -> List[str]:
    """Return arguments with {scene}, {output}, {iterations} and {port} filled in.

    Args:
        script: the training script.
        text: the arguments; None: those of Inria's train.py that the script's source knows, and ``given`` has not.
        given: the arguments that there are already.
        iterations: how many steps are wanted.
        places: the scene and the output.

    Raises:
        LegsError: the text names anything else.
    """
    if text is None:
        files = [path for path in (script, *script.parent.glob("arguments/*.py")) if path.is_file()]
        source = "\n".join(path.read_text(encoding="utf-8", errors="replace") for path in files)
        known = [words for word, words in _ARGUMENTS if word in source and words.split()[0] not in given]
        text = " ".join(known)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        values = {"iterations": iterations, "port": free.getsockname()[1], **places}
    try:
        return [word.format(**values) for word in shlex.split(text)]
    except (KeyError, IndexError, ValueError) as error:
        raise LegsError(
            f"--arguments {text!r}: only {{scene}}, {{output}}, {{iterations}}, {{port}}: {error}"
        ) from None
