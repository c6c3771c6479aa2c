"""Write the table of reasons in docs/patching.md from the rules of legs-patch.

python docs/reasons.py            # write the table
python docs/reasons.py --check    # exit 1 if it is not what the rules say
"""

import re
import sys
from pathlib import Path

from legs_adapters.rules.order import RULES

PAGE = Path(__file__).resolve().parent / "patching.md"
PART = re.compile("(<!-- rules: .*? -->\n).*?(<!-- end of the rules -->)", re.S)


def table():
    """Return the table of rules."""
    rows = [f"| `{rule.id}` | {rule.sentence()} | {rule.reason} |" for rule in RULES.values()]
    return "\n".join(["| rule | why it skips a term | `reason` |", "| --- | --- | --- |", *rows, ""])


def main(arguments):
    """Write the page, or with ``--check`` only compare; return the exit code."""
    text = PAGE.read_text(encoding="utf-8")
    wanted = PART.sub(lambda found: found[1] + table() + found[2], text)
    if "--check" not in arguments:
        PAGE.write_text(wanted, encoding="utf-8")
    return int("--check" in arguments and text != wanted)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
