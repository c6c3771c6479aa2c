"""The page of compatibility: it agrees with corpus.csv, and other documents name the same figures."""

import csv
import importlib.util
import re
import shutil
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
DATA = ROOT / "docs/compatibility"


def load(folder):
    spec = importlib.util.spec_from_file_location("compatibility_build", folder / "build.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


build = load(DATA)
ROWS = build.corpus()
COLUMNS = ["codebase", "commit", "kind", "round", "known", "first", "now", "sites", "view", "rules", "note"]


@pytest.fixture
def copy(tmp_path):
    """The data, the page and the documents that name figures, in a folder of their own."""
    shutil.copytree(DATA, tmp_path / "docs/compatibility", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("docs/compatibility.md", *build.SENTENCES):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / name, tmp_path / name)
    return tmp_path


def edit(path, old, new):
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")


def test_page_and_sentences_are_what_the_rows_say():
    assert build.stale() == []
    assert len(build.PAGE.read_text(encoding="utf-8").splitlines()) <= 120


@pytest.mark.slow
def test_a_changed_verdict_makes_the_page_stale(copy):
    edit(copy / "docs/compatibility/corpus.csv", ",right,right,", ",missed,right,")
    assert load(copy / "docs/compatibility").stale() == ["docs/compatibility.md: run docs/compatibility/build.py"]
    module = load(copy / "docs/compatibility")
    assert module.main([]) == 0
    assert module.main(["--check"]) == 0
    assert "| right | every photometric L1" in module.PAGE.read_text(encoding="utf-8")
    assert module.figures()["first_right"] == build.figures()["first_right"] - 1


def test_a_figure_of_the_readme_that_is_not_counted_is_named(copy):
    edit(copy / "README.md", f"{len(ROWS)} public codebases", "almost 500 public codebases")
    (fault,) = load(copy / "docs/compatibility").stale()
    assert fault.startswith("README.md: must say ")
    assert str(len(ROWS)) in fault


def test_a_misspelt_verdict_is_named(copy):
    edit(copy / "docs/compatibility/corpus.csv", ",right,right,", ",rigth,right,")
    with pytest.raises(
        SystemExit, match=r"corpus\.csv:\d+: [\w.-]+/[\w.-]+: first is 'rigth', not one of right, wrong term"
    ):
        load(copy / "docs/compatibility").main([])


def test_an_unknown_argument_prints_the_usage(capsys):
    assert build.main(["--chekc"]) == 2
    assert "--check" in capsys.readouterr().out


class TestRows:
    def test_names_commits_and_words(self):
        assert list(ROWS[0]) == COLUMNS
        for row in ROWS:
            assert re.fullmatch(r"[\w.-]+/[\w.-]+", row["codebase"]), row
            assert re.fullmatch(r"[0-9a-f]{7}", row["commit"]), row
            assert row["known"] in ("", "yes"), row
            assert bool(row["first"]) == (row["round"] != "0"), row
            assert row["sites"], row
            assert re.fullmatch(r"(([a-z-]+)( [a-z-]+)*)?", row["rules"]), row
        assert len({row["codebase"].lower() for row in ROWS}) == len(ROWS)

    def test_what_was_not_right_has_a_note(self):
        assert [row["codebase"] for row in ROWS if "right" not in (row["first"], row["now"]) and not row["note"]] == []

    def test_every_round_has_its_rules(self):
        assert [entry["round"] for entry in build.read("rounds.csv")] == sorted({row["round"] for row in ROWS}, key=int)


def test_rates_are_those_of_a_second_count():
    with (DATA / "corpus.csv").open(encoding="utf-8", newline="") as file:
        header, *lines = csv.reader(file)
    at = {name: header.index(name) for name in header}
    blind = [line for line in lines if line[at["round"]] != "0"]
    right = [line for line in blind if line[at["first"]] == "right"]
    found = build.figures()
    assert (found["codebases"], found["blind"], found["first_right"]) == (len(lines), len(blind), len(right))
    assert found["first_right_rate"] == f"{round(100 * len(right) / len(blind))}%"
    rounds = Counter(int(line[at["round"]]) for line in blind)
    older = sum(count for number, count in rounds.items() if number <= max(rounds) - 13)
    shown = re.findall(r"^\| (?:1 to )?(\d+) \| .* \| (\d+)(?: \| \d+){4} \|$", found["rounds"], re.M)
    assert shown[0] == (str(max(rounds) - 13), str(older))
    assert [tuple(map(int, row)) for row in shown[1:]] == sorted(rounds.items())[-13:]
