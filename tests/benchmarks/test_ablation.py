"""The ablation: a part that is switched off behaves as if it did not exist, and the table says what that changes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, Dict, List, Tuple

import pytest

if not hasattr(os, "fork"):
    pytest.skip("no os.fork", allow_module_level=True)

from benchmarks import ablation
from tests.benchmarks.test_corpus import run, trees
from tests.support import legs_environment

__all__ = ["trees"]

ROOT = Path(__file__).resolve().parents[2]
KEYS = ("file", "line")


def places(*given: Tuple[str, int]) -> List[Dict[str, Any]]:
    return [dict(zip(KEYS, place)) for place in given]


def in_a_new_process(code: str, *arguments: str) -> Any:
    command = [sys.executable, "-c", f"import json, sys; from benchmarks import ablation\n{code}", *arguments]
    # A process that has torch would copy more for each part that it forks for.
    done = subprocess.run(command, cwd=str(ROOT), env=legs_environment(), stdout=subprocess.PIPE, check=True)
    return json.loads(done.stdout.decode())


@pytest.mark.parametrize(
    ("plan", "word"),
    [
        ({"sites": places(("a.py", 1), ("a.py", 2))}, None),
        ({"sites": places(("a.py", 1), ("a.py", 2), ("a.py", 3))}, "wrong weight"),
        ({"sites": places(("a.py", 3))}, "wrong weight"),
        ({"sites": places(("a.py", 1))}, "missed"),
        ({"sites": places(("a.py", 1)), "problems": places(("a.py", 2))}, "error"),
        ({"sites": places(("a.py", 1), ("a.py", 2)), "problems": places(("b.py", 9))}, "error"),
    ],
)
def test_the_gravest_word_is_said(plan: Dict[str, Any], word: str) -> None:
    assert ablation.outcome({"sites": places(("a.py", 1), ("a.py", 2))}, plan) == word


def test_lines_of_code_are_counted_without_docstrings_comments_and_imports(tmp_path: Path) -> None:
    module = tmp_path / "counted_here.py"
    documented = ['"""Two', "", 'lines."""', "", "import os", "", "# a comment"]
    code_lines = ["A = [", "    1,", "]", "", "def f():", '    """One."""', "    return A"]
    module.write_text("\n".join(documented + code_lines) + "\n")
    code = f"sys.path.insert(0, {str(tmp_path)!r}); import counted_here; print(ablation._lines(counted_here))"
    assert in_a_new_process(code) == 5  # A = [, 1, ], def, return


def test_the_parts_are_those_of_the_registries() -> None:
    from legs_adapters.rules import order

    keys = [part.key for part in ablation.parts()]
    assert len(set(keys)) == len(keys)
    assert {f"rule: {rule.id}" for rule in order.ORDER} <= set(keys)
    assert {"form: Called", "form: Absolute", "words: TARGET", "reader: doubts"} <= set(keys)
    assert all(part.lines > 0 for part in ablation.parts())


def test_a_forked_plan_is_that_of_a_new_process_without_the_part(trees: Path) -> None:
    """Nothing that was kept from the first plan hides what a part decides."""
    folder = str(trees / "splats")
    code = "print(json.dumps(ablation.Checkout(sys.argv[1], 60).ablate()))"
    found = in_a_new_process(code, folder)
    assert found["left"] == []
    assert [(site["file"], site["line"]) for site in found["plan"]["sites"]] == [("train.py", 9)]
    assert {"rule: definition", "form: Called"} <= set(found["spoken"])
    cold = (
        "ablation.parts()\n"
        "ablation.switch_off(*sys.argv[2].split(': ', 1))\n"
        "print(json.dumps(ablation.plan_of(sys.argv[1])))"
    )
    chosen = [part for part in ("rule: definition", "form: Called", "words: TARGET") if part in found["spoken"]]
    for part in chosen:
        assert in_a_new_process(cold, folder, part) == found["without"].get(part, found["plan"]), part


def test_the_table_says_what_each_part_decides(trees: Path, tmp_path: Path) -> None:
    plans = tmp_path / "plans.json"
    assert run(trees, plans, "--save").returncode == 0
    done = run(trees, plans, "--ablate", "--jobs", 2)
    assert done.returncode == 0, done.stderr
    head, _, *lines = done.stdout.splitlines()
    assert head == "| part | lines | has a say in | differs without it in | well known | how | checkouts |"
    rows = {
        cells[0].strip(): [cell.strip() for cell in cells[1:]] for cells in (line[2:-1].split("|") for line in lines)
    }
    # Without the rule of definitions the L1 function's own body is weighted, and without the form there is no call.
    assert rows["rule `definition`"][1:] == ["1", "1", "0", "wrong weight 1", "splats"]
    assert rows["form `Called`"][2] == "1"
    assert rows["rule `tracking`"][1:] == ["0", "0", "0", "", ""]
    kinds = [line.split()[1] for line in lines]
    assert kinds == sorted(kinds, key=ablation.KINDS.index)


def test_a_checkout_that_takes_too_long_is_named(trees: Path, tmp_path: Path) -> None:
    plans = tmp_path / "plans.json"
    plans.write_text("{}")
    done = run(trees, plans, "--ablate", "--limit", "0.001")
    assert done.returncode == 0, done.stderr
    assert "Not finished: splats: no plan within 0.001 s" in done.stdout


def test_options_of_two_kinds_are_refused(trees: Path, tmp_path: Path) -> None:
    done = run(trees, tmp_path / "plans.json", "--ablate", "--save")
    assert done.returncode == 2
    assert "not allowed with argument" in done.stderr
