"""The argument parser of ``legs``: argparse's, whose errors propose the name that was meant."""

from __future__ import annotations

import argparse
import re
from typing import Any, List, NoReturn, Optional, Sequence

from legs_loss.errors import did_you_mean

__all__ = ["Parser"]


class Parser(argparse.ArgumentParser):
    """An ArgumentParser that knows what a mistyped choice or option may have meant."""

    def parse_args(self, args: Optional[Sequence[str]] = None, namespace: Any = None) -> Any:  # type: ignore[override]
        """Parse as argparse does; what no parser knows is an error of the sub-command that it was given to."""
        parsed, extra = self.parse_known_args(args, namespace)
        if extra:
            self._command(parsed).error(f"unrecognized arguments: {' '.join(extra)}")
        return parsed

    def error(self, message: str) -> NoReturn:
        """Print usage and message, and exit with 2."""
        choice = re.search(r"invalid choice: '(.*?)' \(choose from (.*)\)$", message)
        unknown = re.search(r"^unrecognized arguments: (?:.* )??(--?[^\s=]+)", message)
        if choice:
            message += did_you_mean(choice.group(1), re.findall(r"[\w.+-]+", choice.group(2)))
        elif unknown:
            message += did_you_mean(unknown.group(1), self._options())
        super().error(message)

    def _options(self) -> List[str]:
        return [option for action in self._actions for option in action.option_strings]

    def _command(self, parsed: argparse.Namespace) -> argparse.ArgumentParser:
        for action in self._actions:
            if isinstance(action, argparse._SubParsersAction):
                return action.choices[getattr(parsed, action.dest)]
        return self
