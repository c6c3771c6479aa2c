"""The argument parser of the package's commands: argparse's, with errors that propose names, and shell completion."""

from __future__ import annotations

import argparse
import re
from typing import Any, Iterator, NoReturn

from legs_loss.errors import did_you_mean, require
from legs_loss.system.terminal import printable

# The words by which the help shows a value that is a path.
_FOLDERS = {"DIR", "FOLDER", "PHOTOS", "RUN", "SCENE", "STORE"}
_FILES = {"FILE", "IMAGE", "PLY", "PNG", "SCRIPT"}


class Parser(argparse.ArgumentParser):
    """An ArgumentParser that proposes names for mistyped choices and options."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse as argparse does; unknown arguments are an error of the sub-command that was given them."""
        parsed, extra = super().parse_known_args(args, namespace)
        if extra:
            self.error(f"unrecognized arguments: {' '.join(extra)}")
        return parsed, extra

    def error(self, message: str) -> NoReturn:
        """Print usage and message, and exit with 2."""
        choice = re.search(r"invalid choice: '(.*?)' \(choose from (.*)\)$", message)
        unknown = re.search(r"^unrecognized arguments: (?:.* )??(--?[^\s=]+)", message)
        if choice:
            message += did_you_mean(choice.group(1), re.findall(r"[\w.+-]+", choice.group(2)))
        elif unknown:
            known = [option for action in self._actions for option in action.option_strings]
            message += did_you_mean(unknown.group(1), known)
        super().error(printable(message))

    def offer_completion(self) -> None:
        """Add ``--print-completion``, which prints a shell's completion script for this command."""
        what = "print the completion script of a shell, for its start-up file; needs shtab"
        shells = ("bash", "zsh", "tcsh")
        self.add_argument("--print-completion", action=_PrintCompletion, choices=shells, help=what)


class _PrintCompletion(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *given: Any) -> None:
        require("completion", "completion", "shtab")
        import shtab

        for action in _actions(parser):
            words = set(re.findall(r"[A-Z]+", action.metavar)) if isinstance(action.metavar, str) else set()
            if words & (_FILES | _FOLDERS):
                action.complete = shtab.FILE if words & _FILES else shtab.DIRECTORY  # type: ignore[attr-defined]
        print(shtab.complete(parser, given[1]), flush=True)  # flushed here, where a closed pipe is still caught
        parser.exit()


def _actions(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    """Return the actions of a parser and of its sub-commands."""
    for action in parser._actions:
        yield action
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                yield from _actions(command)
