"""The documents: every file, folder, heading and command that they name is there."""

from __future__ import annotations

import json
import re
import runpy
import shutil
from pathlib import Path
from typing import Dict, Set

import pytest

from legs_loss.cli import main

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted({*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("examples/**/*.md")})
PATH = r"(?<![\w/.-])((?:legs_loss|adapters|tests|docs|benchmarks|examples)/[\w./*-]*[\w/*])"


def prose(page: Path) -> str:
    return re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)


def anchors(page: Path) -> Set[str]:
    """The anchors that GitHub gives a page's headings: lower case, spaces as hyphens, no punctuation."""
    heads = re.findall(r"^#+ (.*)$", prose(page), re.M)
    return {re.sub(r"[^\w\- ]", "", head.lower()).strip().replace(" ", "-") for head in heads}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_what_a_page_links_to_is_there(page: Path) -> None:
    for target, anchor in re.findall(r"\]\(([^)#\s:]*)(?:#([^)\s]+))?\)", prose(page)):
        file = page.parent / target if target else page
        assert file.exists(), target
        assert not anchor or anchor in anchors(file), f"{target}#{anchor}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_a_path_of_the_project_that_a_page_names_is_there(page: Path) -> None:
    named = {path for code in re.findall(r"`([^`\n]+)`", prose(page)) for path in re.findall(PATH, code)}
    assert [path for path in sorted(named) if not any(ROOT.glob(path.rstrip("/")))] == []


def test_an_option_that_a_page_gives_to_a_command_is_one_of_it(capsys: pytest.CaptureFixture[str]) -> None:
    known: Dict[str, Set[str]] = {}
    for page in PAGES:
        for name, other, words in re.findall(
            r"\blegs(?: ([a-z]+)|-(patch))\b([^`|#\n]*)", page.read_text(encoding="utf-8")
        ):
            command, words = name or other, words.partition(".py")[0] if name == "run" else words
            given = set(re.findall(r"(?<!\S)--[a-z_]+", words)) - {"--version", "--print-completion"}
            if given and command not in known:
                with pytest.raises(SystemExit):
                    main([command, "--help"])
                known[command] = set(re.findall(r"--[a-z_]+", capsys.readouterr().out))
            assert given <= known.get(command, set()), f"{page.name}: legs {command}{words}"
    assert {"patch", "run", "precompute", "train", "compare"} <= set(known)


def test_readme_fits_a_screen_or_two() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.split()) <= 700
    assert (text.count("!["), len(re.findall(r"^\| --- ", text, re.M))) == (1, 1)  # one picture, one table


@pytest.mark.slow
def test_the_tables_of_the_evidence_are_those_of_its_rows() -> None:
    rebuild = runpy.run_path(str(ROOT / "docs" / "evidence" / "rebuild.py"))
    text = rebuild["TEXT"].read_text(encoding="utf-8")
    assert rebuild["with_tables"](text) == text
    assert rebuild["captures"]() == (ROOT / "docs/evidence/captures.md").read_text(encoding="utf-8")


def test_arms_of_other_seeds_stand_apart_in_a_table_of_the_schedule() -> None:
    by_seeds = runpy.run_path(str(ROOT / "docs" / "evidence" / "rebuild.py"))["_by_seeds"]
    both = [{"arm": arm, "seed": seed} for arm in ("3dgs", "legs") for seed in (0, 1)]
    assert by_seeds(both, "fox, CPU") == [("fox, CPU", both)]
    first, second = [both[0], both[2]], [both[1]]
    assert by_seeds(both[:3], "fox, CPU") == [("fox, CPU, seed 0", first), ("fox, CPU, seed 1", second)]


@pytest.mark.parametrize("machine", ["cpu", "gpu"])
def test_the_rows_of_a_run_are_taken_in_the_place_of_its_earlier_ones(machine: str, tmp_path: Path) -> None:
    copy = tmp_path / "evidence"
    copy.mkdir()
    for name in ("rebuild.py", "schedule_cpu.json", "schedule_gpu.json"):
        shutil.copy(ROOT / "docs" / "evidence" / name, copy)
    before = json.loads((copy / f"schedule_{machine}.json").read_text(encoding="utf-8"))["rows"]
    run = {"scene": "fern", "arm": "3dgs@legs", "seed": 0}
    folder = tmp_path / "out" / ("3dgs-at-legs" if machine == "cpu" else "seed-0/3dgs-at-legs")
    folder.mkdir(parents=True)
    if machine == "cpu":
        (folder / "cfg.json").write_text('{"seed": 0}', encoding="utf-8")
    metrics = {"train": {"psnr": 1.0}, "test": {"psnr": 2.0}, "gaussians": 3, "mean_weight": 4.0}
    extra = {"growth": [], "gpu": "NVIDIA H200"} if machine == "gpu" else {"growth": []}
    views = {"train": {"a": {"psnr": 1.0}}, "test": {"b": {"psnr": 2.0}}}
    (folder / "metrics-500.json").write_text(json.dumps({**metrics, **extra, "views": views}), encoding="utf-8")

    runpy.run_path(str(copy / "rebuild.py"))["take_schedule"](tmp_path / "out", "fern")
    after = json.loads((copy / f"schedule_{machine}.json").read_text(encoding="utf-8"))["rows"]
    mine = [row for row in after if all(row[name] == value for name, value in run.items())]
    assert mine == [{**run, "iteration": 500, "metrics": {**metrics, "views": {"test": views["test"]}}}]
    others = [row for row in before if any(row[name] != value for name, value in run.items())]
    assert len(others) < len(before)
    assert [row for row in after if row not in mine] == others


def test_the_map_has_every_folder_of_the_core_and_of_the_adapters() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    packages = [*(ROOT / "legs_loss").iterdir(), *(ROOT / "adapters/legs_adapters").iterdir()]
    folders = [f"{path.relative_to(ROOT).as_posix()}/" for path in packages if (path / "__init__.py").exists()]
    assert len(folders) > 10
    assert [folder for folder in folders if folder not in text] == []


def test_the_make_targets_and_modules_of_contributing_are_there() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"\bmake (test-slow|\w+)", text)) - {"the"}
    assert {"test", "test-slow", "lint"} <= targets
    assert [target for target in targets if not re.search(rf"^{target}:", makefile, re.M)] == []
    for module in re.findall(r"python -m (benchmarks[\w.]*)", text):
        path = ROOT.joinpath(*module.split("."))
        assert path.with_suffix(".py").exists() or (path / "__main__.py").exists(), module
