"""Diffs and matching lines in bounded time: right where texts can be compared, and never wrong where they cannot."""

from __future__ import annotations

import random
import re

import pytest

pytest.importorskip("libcst")

from legs_adapters.checkout import comparing
from legs_adapters.checkout.comparing import Comparison

HUNK = re.compile(r"@@ -(\d+)(?:,(\d+))? \+(\d+)(?:,(\d+))? @@\n")


def applied(before, diff):
    """Apply a unified diff to a text, as patch(1) would; its numbers must be right."""
    after, at = [], 0
    for line in diff[2:]:
        head = HUNK.fullmatch(line)
        if head is not None:
            start, gone, to, come = (1 if number is None else int(number) for number in head.groups())
            after += before[at : start - (gone > 0)]
            at = start - (gone > 0)
            assert len(after) == to - (come > 0)
            continue
        if line[0] in "- ":
            assert before[at] == line[1:]
            at += 1
        if line[0] in "+ ":
            after.append(line[1:])
    return after + before[at:]


@pytest.mark.parametrize("steps", [comparing.MAX_STEPS, 0], ids=["compared", "not compared"])
def test_random_texts(steps, monkeypatch):
    monkeypatch.setattr(comparing, "MAX_STEPS", steps)
    at = random.Random(0)
    for _ in range(500):
        before = [f"{at.randrange(8)}\n" for _ in range(at.randrange(40))]
        after = list(before)
        for _ in range(at.randrange(4)):
            place = at.randrange(len(after) + 1)
            after[place : place + at.randrange(3)] = [f"{at.randrange(8)}\n" for _ in range(at.randrange(3))]
        assert applied(before, Comparison().unified_diff(before, after, ("a", "b"))) == after
        here = there = 0
        for a, b, size in Comparison().matching_lines(before, after):
            assert a >= here and b >= there and before[a : a + size] == after[b : b + size]
            here, there = a + size, b + size
