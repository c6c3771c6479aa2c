"""Reading against the trace, by rows counted by hand."""

from __future__ import annotations

from benchmarks.traced import Row, compare


def term(line, photometric, *through):
    return {"file": "train.py", "line": line, "through": list(through), "is_photometric": photometric}


def test_a_term_is_right_missed_or_wrong():
    read = {
        "sites": [{"file": "train.py", "line": 10}, {"file": "utils.py", "line": 3}, {"file": "train.py", "line": 30}]
    }
    traced = {
        "traced": [
            term(10, True),
            term(20, True, "utils.py:3"),  # written in the function that the line calls
            term(21, False, "utils.py:3"),  # which a term of depth calls, too
            term(25, True),  # missed
            term(30, False),  # reading would weight it
            term(40, False),
        ]
    }
    assert compare(read, traced) == Row(traced=6, right=2, missed=1, wrong=1)
