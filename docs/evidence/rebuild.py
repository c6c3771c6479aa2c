"""Rebuild the tables and plots of docs/evidence.md, and evidence/captures.md, from the rows beside this file.

    python docs/evidence/rebuild.py                                       # from the .json files beside it
    python docs/evidence/rebuild.py --take OUT docs/evidence/NAME.json    # first: the rows of a `legs compare` folder
    python docs/evidence/rebuild.py --take-schedule OUT SCENE             # first: those of schedule.py, schedule_gpu.py

A table stands in the text between `<!-- NAMES -->` and `<!-- end -->`; TABLES says what it shows.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any, Dict, List, Mapping, NamedTuple, Sequence, Tuple

from legs_loss.lab.experiments.arms import parse_arm
from legs_loss.lab.experiments.running import read_rows
from legs_loss.lab.experiments.statistics import Summary, pooled_difference, summarise_all, times_gaussians
from legs_loss.lab.experiments.tables import difference_cell, times_cell

HERE = Path(__file__).resolve().parent
TEXT = HERE.parent / "evidence.md"
PICTURES = HERE.parent / "pictures"
FRESH = ("fresh_fern", "fresh_monstree", "fresh_kitchen")
CANDIDATE = "percentile=99,normalise=mean,scale=0.6,error=1,curve=C1@3dgs"
CODEBASES = {name: tuple(f"{scene}_{name}_200" for scene in ("fox", "fern", "kitchen")) for name in ("3dgs", "fastgs")}
CODEBASES["mcmc"] = tuple(f"{scene}_mcmc_200" for scene in ("fox", "fern", "kitchen"))
SCHEDULES = {"CPU": "schedule_cpu", "H200": "schedule_gpu", "H100": "schedule_h100"}
PAPERS = "bonsai"  # the capture of the paper's, with a table of its own
SCHEDULE_COLUMNS = {
    "train PSNR": ".2f",
    "train SSIM": ".3f",
    "held-out PSNR": ".2f",
    "held-out SSIM": ".3f",
    "strongest 10%": ".2f",
    "Gaussians": ",.0f",
}
_BY_PARTS = ("legs:until=15000", "legs:from=15000")  # announced in preregistered_schedule.md
SCHEDULE_ARMS = ("3dgs", "legs", "3dgs@legs", "legs:lambda=0.418@3dgs", "legs:mean1@3dgs", "legs-l", "eggs", *_BY_PARTS)
SCHEDULE_TICKS = (500, 1000, 2000, 4000, 7000, 15000, 30000)
SCHEDULE_KEPT = ("train", "test", "gaussians", "mean_weight", "processor_seconds")
PAPERS_SCORES = {"psnr": ".2f", "ssim": ".4f", "lpips": ".4f"}
COLOURS = ("#555555", "#d62728", "#1f77b4", "#2ca02c", "#9467bd", "#ff7f0e", "#8c564b", "#e377c2", "#17becf")
COLUMNS = {
    "train PSNR": ("train", "psnr"),
    "held-out PSNR": ("test", "psnr"),
    "held-out SSIM": ("test", "ssim"),
    "strongest 10%": ("test", "psnr_strong"),
}


class Table(NamedTuple):
    """Differences of arms, each from another one, over captures with the same share each."""

    captures: Tuple[str, ...]
    pairs: Tuple[Tuple[str, str], ...]


def _from_3dgs(*arms: str) -> Tuple[Tuple[str, str], ...]:
    return tuple((arm, "3dgs") for arm in arms)


_CONTROLS = (
    *_from_3dgs("eggs", "legs-l", "legs", "legs:scale", "legs:shuffled", "legs:mean1"),
    ("3dgs@legs", "legs"),
    *_from_3dgs("legs@3dgs", "legs:mean1@3dgs"),
)
_CODEBASE = (*_from_3dgs("eggs", "legs-l", "legs", "legs:scale"), ("3dgs@legs", "legs"))
_CURVES = _from_3dgs("legs", "C5", "legs-l", "C4", "C2")
_ROBUST = _from_3dgs("legs", "legs-robust", "legs-robust@3dgs")
TABLES: Mapping[str, Table] = {
    "fox": Table(("fox",), _CONTROLS),
    "embedded": Table(
        ("embedded",),
        tuple(pair for pair in _CONTROLS if pair[0] in ("legs", "legs:scale", "legs:mean1", "3dgs@legs", "legs@3dgs")),
    ),
    "codebase-3dgs": Table(CODEBASES["3dgs"], _CODEBASE),
    "codebase-fastgs": Table(CODEBASES["fastgs"], _CODEBASE),
    "codebase-mcmc": Table(CODEBASES["mcmc"], _CODEBASE[1:-1]),
    "curves": Table(("fox",), _CURVES),
    "preregistered": Table(FRESH, ((CANDIDATE, "3dgs"),)),
    "degraded-fox": Table(("degraded_fox",), _ROBUST),
}


def take(out: Path, path: Path) -> None:
    """Write a comparison's settings and rows as one compact file."""
    settings, rows = read_rows(out)
    settings.pop("path")
    for row in rows:
        row.get("upstream", {}).pop("pictures", None)
    lines = ",\n".join(json.dumps(_rounded(row), separators=(",", ":")) for row in rows)
    path.write_text(f'{{"settings":{json.dumps(settings)},"rows":[\n{lines}\n]}}\n', encoding="utf-8")


def take_schedule(out: Path, scene: str) -> None:
    """Put the rows of a folder of schedule.py or schedule_gpu.py in the place of those of the same runs."""
    for arm in SCHEDULE_ARMS:
        for folder in (*out.glob(parse_arm(arm).folder), *out.glob(f"seed-*/{parse_arm(arm).folder}")):
            settings = folder / "cfg.json"
            by_gpu = not settings.is_file()
            seed = int(folder.parent.name[5:]) if by_gpu else json.loads(settings.read_text(encoding="utf-8"))["seed"]
            run = {"scene": scene, "arm": arm, "seed": seed}
            rows = []
            for milestone in sorted(int(file.stem[8:]) for file in folder.glob("metrics-*.json")):
                metrics = json.loads((folder / f"metrics-{milestone}.json").read_text(encoding="utf-8"))
                kept = {name: metrics[name] for name in SCHEDULE_KEPT if name in metrics}
                kept["views"] = {"test": metrics["views"]["test"]}
                rows.append({**run, "iteration": milestone, "metrics": _rounded(kept)})
            if rows:
                machine = metrics["gpu"].split()[1] if by_gpu else "CPU"
                _replace(HERE / f"{SCHEDULES[machine]}.json", run, rows)


def _replace(path: Path, run: Mapping[str, Any], rows: Sequence[Any]) -> None:
    found = json.loads(path.read_text(encoding="utf-8"))
    others = [row for row in found["rows"] if any(row[name] != value for name, value in run.items())]
    order = {arm: place for place, arm in enumerate(SCHEDULE_ARMS)}
    rows = sorted([*others, *rows], key=lambda row: (row["scene"], row["seed"], order[row["arm"]], row["iteration"]))
    lines = ",\n".join(map(json.dumps, rows))
    path.write_text(f'{{"schedule": {json.dumps(found["schedule"])},\n"rows": [\n{lines}\n]}}\n', encoding="utf-8")


def differences(table: Table) -> str:
    """Return a table of differences with their intervals; ? marks what is not clear."""
    scenes = [rows_of(capture) for capture in table.captures]
    lines = []
    for arm, reference in table.pairs:
        found = [pooled_difference(scenes, arm, reference, *metric) for metric in COLUMNS.values()]
        cells = [difference_cell(one, metric[1]) for one, metric in zip(found, COLUMNS.values())]
        times = [times_cell(times_gaussians(rows, arm, reference) or 1.0) for rows in scenes]
        name = "the candidate@3dgs" if arm == CANDIDATE else arm
        lines.append([f"{name} − {reference}", *cells, ", ".join(dict.fromkeys(times))])
    return compact(["difference", *COLUMNS, "Gaussians"], lines)


def with_tables(text: str) -> str:
    """Return a text with its tables made anew."""

    def table(match: re.Match[str]) -> str:
        name = match.group(1)
        milestone = re.fullmatch(r"schedule-(\d+)", name)
        body = (
            schedule(int(milestone.group(1)))
            if milestone
            else papers()
            if name == PAPERS
            else object_masks()
            if name == "object-masks"
            else differences(TABLES[name])
        )
        return f"<!-- {name} -->\n\n{body}\n\n<!-- end -->"

    return re.sub(r"<!-- ([\w-]+) -->.*?<!-- end -->", table, text, flags=re.DOTALL)


def schedule(iteration: int) -> str:
    """Return the scores at a milestone of 3DGS's own schedule, by the package's trainer and on a GPU."""
    lines = []
    for machine, name in SCHEDULES.items():
        rows = [row for row in rows_of(name) if row["iteration"] == iteration and row["scene"] != PAPERS]
        for row in rows:
            row["metrics"]["iterations"] = iteration  # a summary has milliseconds by it
        for scene in sorted({row["scene"] for row in rows}):
            for place, some in _by_seeds([row for row in rows if row["scene"] == scene], f"{scene}, {machine}"):
                for one in summarise_all(some, SCHEDULE_ARMS):
                    lines.append([place, one.arm, *(_schedule_cell(one, label) for label in SCHEDULE_COLUMNS)])
    return compact(["capture", "arm", *SCHEDULE_COLUMNS], lines)


def _by_seeds(rows: List[Any], place: str) -> List[Tuple[str, List[Any]]]:
    """Return the rows as one group; by seed where not all arms have the same seeds, so that equals are compared."""
    seeds = {row["seed"] for row in rows}
    if len({(row["arm"], row["seed"]) for row in rows}) == len({row["arm"] for row in rows}) * len(seeds):
        return [(place, rows)]
    return [(f"{place}, seed {seed}", [row for row in rows if row["seed"] == seed]) for seed in sorted(seeds)]


def papers() -> str:
    """Return the scores of the paper's capture over the schedule, one run a line."""
    rows = [(row, machine) for machine, name in SCHEDULES.items() for row in rows_of(name) if row["scene"] == PAPERS]
    lines = []
    for row, machine in sorted(rows, key=lambda one: (one[0]["iteration"], SCHEDULE_ARMS.index(one[0]["arm"]))):
        splits = [row["metrics"][split] for split in ("train", "test")]
        cells = [f"{one[key]:{form}}" if key in one else "" for one in splits for key, form in PAPERS_SCORES.items()]
        metrics = row["metrics"]
        lines.append(
            [
                f"{row['iteration']:,}",
                row["arm"],
                *cells,
                f"{metrics['gaussians']:,}",
                f"{metrics['mean_weight']:.2f}",
                machine,
            ]
        )
    heads = [f"{split} {key.upper()}" for split in ("train", "held-out") for key in PAPERS_SCORES]
    return compact(["iteration", "arm", *heads, "Gaussians", "weight", "on"], lines)


def object_masks() -> str:
    """Return by how much scores inside object masks change where D-SSIM is no longer diluted."""
    lines = []
    rows = rows_of("object_masks")
    for scene in dict.fromkeys(row["scene"] for row in rows):
        some = [row for row in rows if row["scene"] == scene]
        found = {key: pooled_difference([some], "corrected", "diluted", "test", key) for key in PAPERS_SCORES}
        cells = [difference_cell(one, key) for key, one in found.items()]
        lines.append([scene, *cells, times_cell(times_gaussians(some, "corrected", "diluted") or 1.0)])
    return compact(["capture", "held-out PSNR", "SSIM", "LPIPS", "Gaussians"], lines)


def _schedule_cell(one: Summary, label: str) -> str:
    form = SCHEDULE_COLUMNS[label]
    spread = "" if one.seeds == 1 or label == "Gaussians" else f"±{one.spread[label]:{form}}"
    return f"{one.mean[label]:{form}}{spread}"


def compact(heads: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table without padding; numbers stand to the right."""
    rule = ["---"] + ["---:"] * (len(heads) - 1)
    return "\n".join(f"|{'|'.join(cells)}|" for cells in (heads, rule, *lines))


def captures() -> str:
    """Return the page of all captures: each arm's mean scores."""
    parts = [
        "# Every capture, every arm",
        "Made from the rows beside this page by `python docs/evidence/rebuild.py`. Means over seeds; PSNR in dB; "
        "*strong* is the PSNR of the strongest 10% of held-out pixels. What follows from them: "
        "[evidence.md](../evidence.md). Arms that no longer exist (`fading`, `growing`, `multiscale`, `half`, `ssim`, "
        "`error`, `scale=`) and the studies with degraded views are trained by commit b401bbf.",
    ]
    for path in sorted(HERE.glob("*.json")):
        found = json.loads(path.read_text(encoding="utf-8"))
        if "settings" not in found:
            continue
        base, scene, by = found["settings"]["base"], found["settings"]["scene"], found["settings"].get("upstream")
        trainer = f"by the script of {by['profile']}" if by else "by the package's trainer"
        views = f"{scene['name']}, {scene['views']} photographs, `-r {base['resolution']}`"
        parts.append(
            f"## {path.stem}\n\n{views}, {base['iterations']:,} iterations, {trainer}.\n\n{_scores(found['rows'])}"
        )
    return "\n\n".join(parts) + "\n"


def _scores(rows: List[Any]) -> str:
    lines = []
    for summary in summarise_all(rows, sorted({row["arm"] for row in rows}, key=_order)):
        mean = summary.mean
        psnr = [f"{mean['train PSNR']:.2f}", f"{mean['train SSIM']:.4f}", f"{mean['held-out PSNR']:.2f}"]
        rest = [f"{mean['held-out SSIM']:.4f}", f"{mean['strongest 10%']:.2f}", f"{mean['Gaussians']:,.0f}"]
        lines.append([f"`{summary.arm}`", *psnr, *rest, str(summary.seeds)])
    return compact(["arm", "train", "SSIM", "held-out", "SSIM", "strong", "Gaussians", "seeds"], lines)


def _order(arm: str) -> Tuple[int, str]:
    first = ("3dgs", "eggs", "legs-l", "legs")
    return (first.index(arm) if arm in first else len(first), arm)


def plots() -> None:
    """Draw PSNR by Gaussians, the codebases' differences, the curves, and the scores over 3DGS's schedule."""
    from matplotlib.figure import Figure

    figure: Any = Figure(figsize=(11, 8.4), constrained_layout=True)
    grid = figure.subplots(2, 2)
    arms = ("3dgs", *dict.fromkeys(arm for arm, _ in _CONTROLS))
    for panels, scene in zip(grid, ("fox", "embedded")):
        found = summarise_all(rows_of(scene), arms)
        for panel, score in zip(panels, ("train PSNR", "held-out PSNR")):
            values = [summary.mean[score] for summary in found]
            line = 0.05 * (max(values) - min(values))  # a label's height, in dB
            labels: List[Tuple[float, float]] = []  # places of those that are written
            for summary in sorted(found, key=lambda one: one.mean[score]):
                x, y = summary.mean["Gaussians"] / 1000, summary.mean[score]
                at = max([y] + [below + line for beside, below in labels if abs(beside - x) < 10])
                labels.append((x, at))
                plain = summary.arm.startswith("3dgs")
                colour = "#555555" if plain else "#d62728" if summary.arm == "legs" else "#1f77b4"
                panel.errorbar(x, y, summary.spread[score], fmt="s" if plain else "o", color=colour, markersize=6)
                panel.annotate(f"  {summary.arm}", (x, at), fontsize=9, color=colour, va="center")
            panel.set(xlabel="thousand Gaussians", ylabel=f"{score}, dB", title=scene)
            panel.margins(x=0.25, y=0.12)
            panel.grid(alpha=0.3)
    _save(figure, "evidence_gaussians.png")

    figure = Figure(figsize=(11, 3.4), constrained_layout=True)
    for panel, (name, label) in zip(
        figure.subplots(1, 3, sharex=True), (("3dgs", "3DGS"), ("fastgs", "FastGS"), ("mcmc", "3DGS-MCMC"))
    ):
        table = TABLES[f"codebase-{name}"]
        scenes = [rows_of(capture) for capture in table.captures]
        for place, (arm, reference) in enumerate(reversed(table.pairs)):
            for offset, colour, metric in ((0.15, "#1f77b4", "train PSNR"), (-0.15, "#d62728", "held-out PSNR")):
                one = pooled_difference(scenes, arm, reference, *COLUMNS[metric])
                assert one is not None
                panel.plot([one.low, one.high], [place + offset] * 2, color=colour, linewidth=2)
                panel.plot(one.mean, place + offset, "o", color=colour, label=metric if place == 0 else None)
        panel.set_yticks(range(len(table.pairs)), [f"{arm} − {to}" for arm, to in reversed(table.pairs)], fontsize=9)
        panel.axvline(0, color="#999999", linewidth=1)
        panel.set(title=label, xlabel="dB")
        panel.grid(alpha=0.3)
    figure.axes[-1].legend(fontsize=8, loc="center right")
    _save(figure, "evidence_codebases.png")

    runs: Dict[Tuple[str, str, str, int], List[Any]] = {}
    for machine, name in SCHEDULES.items():
        for row in rows_of(name):
            runs.setdefault((row["scene"], row["arm"], machine, row["seed"]), []).append(row)
    figure = Figure(figsize=(14, 14.5), constrained_layout=True)
    scores = {
        f"{label} {name}": (split, name.lower())
        for name in ("PSNR", "SSIM")
        for split, label in (("train", "train"), ("test", "held-out"))
    }
    for scene, panels in zip(("fern", "kitchen", "fox", PAPERS), figure.subplots(4, 4)):
        for panel, (label, (split, key)) in zip(panels, scores.items()):
            for arm, colour in zip(SCHEDULE_ARMS, COLOURS):
                lines = [(run, rows) for run, rows in runs.items() if run[:2] == (scene, arm)]
                for place, ((_, _, machine, _), rows) in enumerate(lines):
                    points = sorted((row["iteration"], row["metrics"][split][key]) for row in rows)
                    style = "-" if machine == "CPU" else ":"
                    panel.plot(*zip(*points), style, color=colour, label=None if place else arm)
            panel.set(title=f"{scene}: {label}", xlabel="iteration", xscale="log", xlim=(450, 33000))
            panel.set_xticks(SCHEDULE_TICKS, [f"{tick / 1000:g}k" for tick in SCHEDULE_TICKS])
            panel.minorticks_off()
            panel.grid(alpha=0.3)
        panels[-1].legend(fontsize=8, loc="lower center")
    _save(figure, "evidence_schedule.png")


def _save(figure: Any, name: str) -> None:
    # Without the version of matplotlib in it, so that drawing it again changes no byte.
    figure.savefig(str(PICTURES / name), dpi=110, facecolor="white", metadata={"Software": None})


def rows_of(capture: str) -> List[Any]:
    """Return a capture's rows."""
    return json.loads((HERE / f"{capture}.json").read_text(encoding="utf-8"))["rows"]


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.6g}")
    if isinstance(value, dict):
        return {name: _rounded(one) for name, one in value.items()}
    return [_rounded(one) for one in value] if isinstance(value, list) else value


def main(words: List[str]) -> None:
    """Take the rows that are named, then rebuild."""
    while words[:1] == ["--take"]:
        take(Path(words[1]), Path(words[2]))
        words = words[3:]
    while words[:1] == ["--take-schedule"]:
        take_schedule(Path(words[1]), words[2])
        words = words[3:]
    TEXT.write_text(with_tables(TEXT.read_text(encoding="utf-8")), encoding="utf-8")
    (HERE / "captures.md").write_text(captures(), encoding="utf-8")
    plots()


if __name__ == "__main__":
    main(sys.argv[1:])
