"""Compare what reading chose in a checkout with what a trace saw: a row of docs/compatibility/traced.csv.

legs-patch CHECKOUT --check --json > read.json
legs-patch CHECKOUT --trace "train.py ..." --cpu --check --json > traced.json
python -m benchmarks.traced read.json traced.json
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any, Dict, NamedTuple, Set


class Row(NamedTuple):
    """The counts of a codebase: traced terms, photometric ones that reading has and misses, others that it has."""

    traced: int
    right: int
    missed: int
    wrong: int


def compare(read: Dict[str, Any], traced: Dict[str, Any]) -> Row:
    """Return the counts; a term is reading's where one of the lines that it goes through is a site of reading's.

    A site that photometric terms and others share is not counted as wrong: the trace's own verdict is asked there.
    """
    sites = {f"{site['file']}:{site['line']}" for site in read["sites"]}
    photometric = [_lines(term) for term in traced["traced"] if term["is_photometric"]]
    others = [_lines(term) for term in traced["traced"] if not term["is_photometric"]]
    right = sum(bool(lines & sites) for lines in photometric)
    wrong = sum(bool((lines & sites) - set().union(*photometric)) for lines in others)
    return Row(len(traced["traced"]), right, len(photometric) - right, wrong)


def _lines(term: Dict[str, Any]) -> Set[str]:
    return {f"{term['file']}:{term['line']}", *term["through"]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("read", type=Path)
    parser.add_argument("traced", type=Path)
    args = parser.parse_args()
    row = compare(*(json.loads(path.read_text(encoding="utf-8")) for path in (args.read, args.traced)))
    print(", ".join(f"{name} {count}" for name, count in row._asdict().items()))


if __name__ == "__main__":
    main()
