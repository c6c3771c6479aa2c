"""The command that trains: its program, its arguments, and the folders that it names."""

from __future__ import annotations

import itertools
import os
import shlex
import socket
import sys
from pathlib import Path
from typing import List, NamedTuple, Optional, Sequence

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


class Command(NamedTuple):
    """A command that trains.

    Attributes:
        launcher: what stands before the program, `torchrun` say; nothing for python itself.
        program: the script, or `-m` and a module.
        script: the program's file in the checkout.
        arguments: its arguments.
    """

    launcher: List[str]
    program: List[str]
    script: str
    arguments: List[str]

    @classmethod
    def parse(cls, root: Path, text: str) -> Command:
        """Return a command as it is typed in a checkout.

        Raises:
            LegsError: it has unbalanced quotes, or names no script and no module that is there.
        """
        try:
            words = shlex.split(text)
        except ValueError as error:
            raise LegsError(f"--trace {text!r}: {error}") from None
        for at, word in enumerate(words):
            is_module, path = words[at - 1 : at] == ["-m"], word.replace(".", "/")
            names = [f"{path}.py", f"{path}/__main__.py"] if is_module else [word] if word.endswith(".py") else []
            script = next((name for name in names if (root / name).is_file()), None)
            if script is not None:
                begin = at - is_module
                return cls(_launcher(words[:begin]), words[begin : at + 1], script, words[at + 1 :])
            if word.endswith(".py"):
                raise LegsError(f"--trace: there is no {word} in {root}")
        raise LegsError(f'--trace {text!r} names no script, and no module in {root}: --trace "train.py -s SCENE"')


def _launcher(before: List[str]) -> List[str]:
    """Return the words before a program, without python; of a shell's `CUDA_VISIBLE_DEVICES=0 python` with `env`."""
    variables = list(itertools.takewhile(lambda word: "=" in word, before))
    program = before[len(variables) :]
    if all(os.path.basename(word).startswith("python") or word == "-u" for word in program):
        program = [sys.executable] if variables else []
    return ["env", *variables, *program] if variables else program


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
        files = [path for path in (script, *script.parent.glob("arguments/*.py")) if path.is_file()]  # no pipe
        source = "\n".join(path.read_text(encoding="utf-8", errors="replace") for path in files)
        text = " ".join(words for word, words in _ARGUMENTS if word in source and words.split()[0] not in given)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        values = {"iterations": iterations, "port": free.getsockname()[1], **places}
    try:
        return [word.format(**values) for word in shlex.split(text)]
    except (KeyError, IndexError, ValueError) as error:
        known = "only {scene}, {output}, {iterations}, {port}"
        raise LegsError(f"--arguments {text!r}: {known}: {error}") from None
