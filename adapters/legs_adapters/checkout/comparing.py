"""Compare the lines of two texts in bounded time: some files make a plain diff take days."""

from __future__ import annotations

import difflib
import itertools
import re
from collections import Counter
from typing import Any, List, Mapping, Sequence, Tuple, TypeVar

__all__ = ["Comparison"]

MAX_STEPS = 2_000_000  # lines, and pairs of equal lines, that are looked at in all files: some seconds
_CONTEXT = 3  # lines around a change in a diff
_HUNK = re.compile(r"@@ -(\d+)(.*) \+(\d+)(.*@@\n)", re.S)
_Line = TypeVar("_Line", str, bytes)


class Comparison:
    """Compares files of one checkout, in a bounded number of steps together."""

    def __init__(self) -> None:
        self._left: int = MAX_STEPS

    def matching_lines(self, before: Sequence[_Line], after: Sequence[_Line]) -> List[Tuple[int, int, int]]:
        """Return the blocks of lines that two texts share, in order: where in each, and how many lines.

        Everything between the first and the last difference counts as different where it is too long or too repetitive
        to be compared.
        """
        try:
            self.spend(len(before) + len(after))
            head, tail = _ends(before, after)
        except _TooLongError:
            return []
        blocks: List[Tuple[int, int, int]] = [(0, 0, head)]
        try:
            matcher = _Matcher(self, before[head : len(before) - tail], after[head : len(after) - tail])
            blocks += [(head + block.a, head + block.b, block.size) for block in matcher.get_matching_blocks()]
        except _TooLongError:
            pass
        return [block for block in [*blocks, (len(before) - tail, len(after) - tail, tail)] if block[2]]

    def unified_diff(self, before: Sequence[str], after: Sequence[str], names: Tuple[str, str]) -> List[str]:
        """Return the lines of a unified diff of two texts; a single hunk where comparing would take too long."""
        head, tail = _ends(before, after)
        start = max(head - _CONTEXT, 0)
        removed, added = (lines[start : len(lines) - max(tail - _CONTEXT, 0)] for lines in (before, after))
        try:
            if removed and added:
                _Matcher(self, removed, added).get_matching_blocks()
        except _TooLongError:
            where = f"@@ -{start + 1},{len(removed)} +{start + 1},{len(added)} @@\n"
            changed = [f"-{line}" for line in removed] + [f"+{line}" for line in added]
            return [f"--- {names[0]}\n", f"+++ {names[1]}\n", where, *changed]
        diff = difflib.unified_diff(removed, added, *names, n=_CONTEXT, lineterm="\n")
        return [
            _HUNK.sub(lambda at: f"@@ -{int(at[1]) + start}{at[2]} +{int(at[3]) + start}{at[4]}", line)
            if line.startswith("@@")
            else line
            for line in diff
        ]

    def spend(self, steps: int) -> None:
        """Count steps; raise an error where there are none left."""
        if steps > self._left:
            raise _TooLongError
        self._left -= steps


class _TooLongError(Exception):
    pass


class _Matcher(difflib.SequenceMatcher):
    """Match lines, and count the steps: difflib's are cubic in lines that are alike, or in another order."""

    def __init__(self, comparison: Comparison, before: Sequence[_Line], after: Sequence[_Line]) -> None:
        comparison.spend(len(before) + len(after))
        counts: Mapping[Any, int] = Counter(after)
        self._comparison: Comparison = comparison
        self._steps: List[int] = [0, *itertools.accumulate(1 + counts[line] for line in before)]
        super().__init__(None, before, after, autojunk=False)

    def find_longest_match(self, alo: int = 0, ahi: Any = None, blo: int = 0, bhi: Any = None) -> Any:
        """Find the longest block of equal lines in parts of both texts."""
        self._comparison.spend(self._steps[ahi] - self._steps[alo])
        return super().find_longest_match(alo, ahi, blo, bhi)


def _ends(before: Sequence[_Line], after: Sequence[_Line]) -> Tuple[int, int]:
    """Return how many lines two texts share at their starts, and how many more at their ends."""
    shorter = min(len(before), len(after))
    head = next((i for i in range(shorter) if before[i] != after[i]), shorter)
    tail = next((i for i in range(shorter - head) if before[-1 - i] != after[-1 - i]), shorter - head)
    return head, tail
