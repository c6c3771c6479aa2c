"""The ``legs`` command. Each sub-command is one module: HELP, add_arguments(parser), run(args).

It is in this folder, or registered in the entry point group ``legs_loss.commands``, as the lab's and the adapters' are.
"""

from __future__ import annotations

import argparse
import functools
import importlib
import sys
from contextlib import suppress
from typing import Any, Callable, Dict, Optional, Sequence

from legs_loss._version import __version__
from legs_loss.cli.shared.parser import Parser as Parser
from legs_loss.errors import LegsError
from legs_loss.system.entry_points import plugins
from legs_loss.system.terminal import say

COMMANDS = ("masks", "precompute", "export", "show", "info", "env")

EXIT_CODES = "exit codes: 0 done; 1 done, but some items failed; 2 bad input or usage; 130 interrupted"


def main(argv: Optional[Sequence[str]] = None) -> int:
    """Run ``legs`` with these arguments (default: the process's own) and return its exit code."""
    never_fail_to_print()
    return exit_code("legs", lambda: _run(argv))


def _run(argv: Optional[Sequence[str]]) -> int:
    parser = _parser()
    args = parser.parse_args(argv)
    if args.command is None:  # not an error: a user asks what there is
        say(parser.format_help(), lines=True)
        return 0
    return args.run(args)


def exit_code(command: str, work: Callable[[], int], so_far: Callable[[], str] = str) -> int:
    """Return the exit code of a command's work; an error is a line on stderr.

    Args:
        command: its name.
        work: all of it, which returns its exit code.
        so_far: returns what an interrupted one has done, to be said behind that it was.
    """
    try:
        return work()
    except LegsError as error:
        say_error(command, error)
    except KeyboardInterrupt:
        say(f"{command}: interrupted{so_far()}", sys.stderr)
        return 130
    except MemoryError as error:
        say(f"{command}: error: not enough memory{f' ({error})' if str(error) else ''}", sys.stderr)
    except BrokenPipeError:  # `legs ... | head`: the reader left, which is no error of ours
        sys.stderr.close()
        return 0
    except OSError as error:  # a full disk, a folder that went away
        where = f"{error.filename}: " if error.filename is not None else ""
        say(f"{command}: error: {where}{error.strerror or str(error)[:500]}{so_far()}", sys.stderr)
    return 2


def never_fail_to_print() -> None:
    """Print characters that the terminal's encoding lacks as escapes, instead of raising an error."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(AttributeError):  # replacements in tests and notebooks have no such method
            stream.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]


def say_error(command: str, error: Exception) -> None:
    """Print a command's error to stderr: its message on one line, then the quoted lines, if any."""
    message, *quoted = error.args or ("",)
    say(f"{command}: error: {message}", sys.stderr)
    for text in quoted:
        say(text, sys.stderr, lines=True)


def _parser() -> argparse.ArgumentParser:
    parser = Parser(prog="legs", description="The LEGS loss for 3D Gaussian Splatting.", epilog=EXIT_CODES)
    parser.add_argument("--version", action="version", version=f"legs-loss {__version__}")
    parser.offer_completion()
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    own = {name: functools.partial(importlib.import_module, f"{__name__}.{name}") for name in COMMANDS}
    loaders: Dict[str, Callable[[], Any]] = {**own, **plugins("legs_loss.commands")}
    for name, load in loaders.items():
        command = load()
        sub = commands.add_parser(name, help=command.HELP, description=command.__doc__, epilog=EXIT_CODES)
        command.add_arguments(sub)
        sub.set_defaults(run=command.run)
    return parser
