"""Write docs/compatibility.md from the csv files beside this script and page.txt; every figure on it is counted here.

python docs/compatibility/build.py            # write the page
python docs/compatibility/build.py --check    # exit 1 if the page is not what the data says
"""

import csv
import re
import sys
from collections import Counter
from pathlib import Path
from string import Template

HERE = Path(__file__).resolve().parent
DOCS = HERE.parent
PAGE = DOCS / "compatibility.md"
KINDS = (
    *("static", "surfels", "dynamic", "avatar", "SLAM", "feed-forward", "language", "generation", "compression"),
    *("framework", "other"),
)

# A row with several failures carries the gravest of them: this order, after "right".
VERDICTS = {
    "right": "every photometric L1 of a training step is chosen, and nothing else",
    "wrong term": "something is weighted that must not be",
    "missed": "a term is not found, or lies in a folder that is not entered",
    "wrong form": "a line that stops at the first step, or weights the wrong axes",
    "wrong view": "a `view=` that no view has, or that several have",
    "error": "an error that quotes a line; nothing is written",
    "false alarm": "an error on a line that is not the loss; nothing is written",
    "timeout": "no answer within 500 s",
}

# Where other documents name a figure: the sentence that must stand there.
SENTENCES = {
    "README.md": "It was tried on $codebases public codebases. "
    "Of the last $newest, never met before, $newest_rate were right at first contact",
    "docs/patching.md": "says what it does to $codebases public codebases",
    "docs/codebases/3dgs.md": "What was chosen in each of $codebases is in [the list]",
    "docs/codebases/others.md": "among the $codebases that were tried",
    "mkdocs.yml": "- $codebases codebases: compatibility.md",
}


def read(name):
    """Return the rows of a csv file beside this script as dictionaries."""
    with (HERE / name).open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def corpus():
    """Return the rows of corpus.csv; exit with the row, if one has a word that no figure counts."""
    rows = read("corpus.csv")
    for line, row in enumerate(rows, 2):
        for key, words in (("kind", KINDS), ("first", VERDICTS), ("now", VERDICTS)):
            if row[key] not in words and not (key == "first" and row["round"] == "0" and row[key] == ""):
                sys.exit(f"corpus.csv:{line}: {row['codebase']}: {key} is {row[key]!r}, not one of {', '.join(words)}")
    return rows


def rate(part, whole):
    """Return a share in whole percent."""
    return f"{100 * part / whole:.0f}%"


def right_of(rows):
    """Return 'N of M (P%)': how many rows were right at first contact."""
    right = sum(row["first"] == "right" for row in rows)
    return f"{right} of {len(rows)} ({rate(right, len(rows))})"


def fair_of(rows, when):
    """Return 'N of M (P%)': how many rows were right or an error on the very line, "first" or "now"."""
    fair = sum(row[when] in ("right", "error") for row in rows)
    return f"{fair} of {len(rows)} ({rate(fair, len(rows))})"


def by_kind(rows):
    """Return the rows of each kind that has any."""
    kinds = {kind: [row for row in rows if row["kind"] == kind] for kind in KINDS}
    return {kind: of for kind, of in kinds.items() if of}


def names(rows):
    """Return the codebases' names without their owners, separated by commas."""
    return ", ".join(row["codebase"].split("/")[1] for row in rows)


def verdict_table(blind):
    """Return the table of verdicts at first contact and now."""
    first, now = (Counter(row[key] for row in blind) for key in ("first", "now"))
    cell = lambda count: f"{count} ({100 * count / len(blind):.1f}%)" if count else "–"  # noqa: E731
    lines = ["| verdict | meaning | at first contact | now |", "| --- | --- | --- | --- |"]
    return "\n".join(lines + [f"| {v} | {text} | {cell(first[v])} | {cell(now[v])} |" for v, text in VERDICTS.items()])


def round_table(blind):
    """Return the table of rounds, with the rules that each of them met; the older ones in one row."""
    shown = ("right", "error", "wrong term", "false alarm")
    lines = [f"| round | rules of | codebases | {' | '.join(shown)} |", "| --- | --- " + "| --- " * 5 + "|"]
    recent = recent_from(blind)
    older = [row for row in blind if int(row["round"]) < recent]
    entries = read("rounds.csv")
    until = re.search(r"\b[0-9a-f]{7}\b", entries[recent - 1]["rules"]).group()
    rounds = [(f"1 to {recent - 1}", f"commits 77fafa3 to {until}: [rounds.csv](compatibility/rounds.csv)", older)]
    for entry in entries:
        if int(entry["round"]) >= recent:
            rounds.append((entry["round"], entry["rules"], [row for row in blind if row["round"] == entry["round"]]))
    for name, rules, rows in rounds:
        counts = Counter(row["first"] for row in rows)
        lines.append(f"| {name} | {rules} | {len(rows)} | {' | '.join(str(counts[verdict]) for verdict in shown)} |")
    return "\n".join(lines)


def recent_from(blind):
    """Return the first of the last thirteen rounds."""
    return max(int(row["round"]) for row in blind) - 12


def parts_that_decide(kind):
    """Return the parts of a kind without which some site differs, each with the number of codebases where."""
    rows = [row for row in read("parts.csv") if row["kind"] == kind and row["decides"] != "0"]
    return ", ".join(f"`{row['name']}` {row['decides']}" for row in rows)


def parts_that_do_not(*kinds):
    """Return the parts of these kinds without which no site differs."""
    rows = [row for row in read("parts.csv") if row["kind"] in kinds and row["decides"] == "0"]
    return ", ".join(f"`{row['name']}`" for row in rows)


def figures():
    """Return every figure and list of the page, counted from the rows."""
    rows = corpus()
    blind = [row for row in rows if row["round"] != "0"]
    known = [row for row in rows if row["known"]]
    last = max(int(row["round"]) for row in blind)
    recent = [row for row in blind if int(row["round"]) >= recent_from(blind)]
    latest = [row for row in blind if int(row["round"]) == last]
    newest = [row for row in blind if int(row["round"]) >= last - 1]
    traced = read("traced.csv")
    ran = [row for row in traced if row["traced"]]
    first = Counter(row["first"] for row in blind)
    now = Counter(row["now"] for row in rows)
    failed = {verdict: names([row for row in rows if row["now"] == verdict]) for verdict in VERDICTS}
    return {
        "codebases": len(rows),
        "developed": len(rows) - len(blind),
        "blind": len(blind),
        "first_right": first["right"],
        "first_right_rate": rate(first["right"], len(blind)),
        "now_right": now["right"],
        "now_right_rate": rate(now["right"], len(rows)),
        "recent": right_of(recent),
        "recent_first": recent_from(blind),
        "recent_last": last,
        "recent_wrong": sum(row["first"] == "wrong term" for row in recent),
        "latest": right_of([row for row in blind if int(row["round"]) > last - 4]),
        "traced": len(traced),
        "ran": len(ran),
        **{f"ran_{key}": sum(int(row[key]) for row in ran) for key in ("traced", "right", "missed", "wrong")},
        "newest": len(newest),
        "newest_rate": rate(sum(row["first"] == "right" for row in newest), len(newest)),
        "newest_fair": fair_of(newest, "first"),
        "last": right_of(latest),
        "last_wrong": sum(row["first"] == "wrong term" for row in latest),
        "last_alarms": sum(row["first"] == "false alarm" for row in latest),
        "last_fair": fair_of(latest, "first"),
        "last_now_fair": fair_of(latest, "now"),
        "last_now_wrong": sum(row["now"] == "wrong term" for row in latest),
        "last_now_alarms": sum(row["now"] == "false alarm" for row in latest),
        "last_with": right_of([row for row in latest if row["sites"] != "none"]),
        "last_kinds": ", ".join(
            f"{kind} {right_of(rows).split(' (')[0].replace(' of ', '/')}" for kind, rows in by_kind(latest).items()
        ),
        "verdicts": verdict_table(blind),
        "rounds": round_table(blind),
        "known": len(known),
        "known_right": sum(row["now"] == "right" for row in known),
        "known_blind": right_of([row for row in known if row["round"] != "0"]),
        "known_names": names(known),
        "wrong_now": failed["wrong term"],
        "view_now": failed["wrong view"],
        "missed_count": now["missed"],
        "missed_now": failed["missed"],
        "error_count": now["error"],
        "error_now": failed["error"],
        "planned": sum(row["rules"] != "" for row in rows),
        "ablated": read("parts.csv")[0]["of"],
        "deciding_rules": parts_that_decide("rule"),
        "deciding_forms": parts_that_decide("form"),
        "deciding_readers": parts_that_decide("reader"),
        "deciding_words": parts_that_decide("words"),
        "idle": parts_that_do_not("rule", "form", "reader"),
        "idle_words": parts_that_do_not("words").count(",") + 1,
    }


def page():
    """Return the page that the data gives."""
    return Template((HERE / "page.txt").read_text(encoding="utf-8")).substitute(figures())


def stale():
    """Return the texts that disagree with the data: the page, or a sentence of another document."""
    faults = (
        [] if PAGE.read_text(encoding="utf-8") == page() else ["docs/compatibility.md: run docs/compatibility/build.py"]
    )
    for name, sentence in SENTENCES.items():
        expected = Template(sentence).substitute(figures())
        if expected not in re.sub(r"\s+", " ", (DOCS.parent / name).read_text(encoding="utf-8")):
            faults.append(f"{name}: must say {expected!r}")
    return faults


def main(arguments):
    """Write the page, or check it."""
    if arguments == ["--check"]:
        faults = stale()
        print("\n".join(faults) or "docs/compatibility.md is what the data says")
        return 1 if faults else 0
    if arguments:
        print(__doc__)
        return 2
    PAGE.write_text(page(), encoding="utf-8")
    print(f"{PAGE.name}: {len(page().splitlines())} lines")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
