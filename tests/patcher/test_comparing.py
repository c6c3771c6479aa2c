"""Diffs in bounded time: short for what a patch writes, and right for any texts."""

from __future__ import annotations

import difflib
import random
import re

from legs_adapters.checkout.comparing import compared, unified_diff

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


def test_random_texts():
    at = random.Random(0)
    for _ in range(500):
        before = [f"{at.randrange(8)}\n" for _ in range(at.randrange(40))]
        after = list(before)
        for _ in range(at.randrange(4)):
            place = at.randrange(len(after) + 1)
            after[place : place + at.randrange(3)] = [f"{at.randrange(8)}\n" for _ in range(at.randrange(3))]
        assert applied(before, unified_diff(before, after, ("a", "b"))) == after


def test_single_lines_are_found_as_difflib_finds_them():
    """Lines of their own, and lines that were replaced: the same diff as the standard library's."""
    at = random.Random(1)
    for _ in range(200):
        before = [f"line {number} {at.random()}\n" for number in range(60)]
        after = []
        for number, line in enumerate(before):
            what = at.randrange(6) if number % 3 == 1 else 9
            after += [[f"new {at.random()}\n", line], [f"other {at.random()}\n"]][what] if what < 2 else [line]
        for one, other in ((before, after), (after, before)):
            assert unified_diff(one, other, ("a", "b")) == list(difflib.unified_diff(one, other, "a", "b"))
    assert unified_diff(["a\n"], ["a\n"], ("a", "b"))[2:] == unified_diff([], [], ("a", "b"))[2:] == []
    assert compared(["a\n"], ["a\n"]) == [("equal", 0, 1, 0, 1)]
