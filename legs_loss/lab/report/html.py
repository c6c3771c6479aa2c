"""A comparison as one self-contained HTML page: sortable tables, plots, a slider between methods, crops."""

from __future__ import annotations

import base64
import hashlib
import json
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any, Dict, List, Mapping, Optional, Sequence

from torch import Tensor

from legs_loss.errors import LegsError
from legs_loss.lab.experiments.arms import BASELINE, parse_arm
from legs_loss.lab.experiments.running import Row, read_rows, scene_of
from legs_loss.lab.experiments.statistics import COLUMNS, Difference, difference, times_gaussians
from legs_loss.lab.experiments.tables import (
    MISSING,
    differences_table,
    scores_table,
    too_short,
)
from legs_loss.lab.report.html_pictures import FORMATS as IMAGE_FORMATS
from legs_loss.lab.report.html_pictures import ViewPictures, draw_row, encode
from legs_loss.lab.report.html_plots import by_gaussians, by_iterations
from legs_loss.lab.training.dataset import load_dataset, load_view, open_store, split_views, with_user_maps
from legs_loss.lab.training.trainer import TrainConfig
from legs_loss.precompute.photograph import levels_of
from legs_loss.scenes import Scene, View
from legs_loss.system.files import write_whole

LIMIT = 10_000_000  # bytes of a page
VIEWS = 3  # shown unless others are asked for


def write_report(
    run: Path,
    path: Path,
    views: Optional[Sequence[str]] = None,
    arms: Optional[Sequence[str]] = None,
    scene: Optional[Path] = None,
) -> Path:
    """Write the page of a comparison.

    Args:
        run: the folder that ``legs compare`` wrote.
        path: of the page.
        views: names of the views to show, or parts of names; default: three of those held out.
        arms: default: all that have rows.
        scene: the scene's folder, if it was moved.

    Returns:
        ``path``.

    Raises:
        LegsError: there is no comparison, the scene or a view is not found, or the page would pass :data:`LIMIT`.
    """
    settings, rows = read_rows(run)
    names = _arms(rows, arms)
    rows = [row for row in rows if row["arm"] in names]
    read = scene_of(settings, scene)
    shown = _views(read, views)
    first: Dict[str, Row] = {}
    for row in sorted(rows, key=lambda row: row["seed"]):
        first.setdefault(row["arm"], row)
    base = TrainConfig.from_dict(settings["base"])
    levels = _scene_levels(read, base, first)
    folders = {arm: run / parse_arm(arm).folder / f"seed-{first[arm]['seed']}" for arm in names}
    drawn, store = [], open_store(read)
    for view in (with_user_maps(load_view(read, view, base.resolution), store, needed=False) for view in shown):
        drawn.append((view, {arm: draw_row(first[arm], folders[arm], view, levels.get(arm)) for arm in names}))
    for form in IMAGE_FORMATS:
        page = _page(settings, rows, names, [encode(view, each, form) for view, each in drawn], first, run)
        data = page.encode("utf-8")
        if len(data) < LIMIT:
            write_whole(path, data, folders=True)
            return path
    raise LegsError(
        f"the page would have {len(data) / 1e6:.0f} MB, above {LIMIT / 1e6:.0f}: choose fewer --views or --arms"
    )


def _page(
    settings: Mapping[str, Any],
    rows: Sequence[Row],
    arms: Sequence[str],
    views: Sequence[ViewPictures],
    first: Mapping[str, Row],
    run: Path,
) -> str:
    from jinja2 import Environment
    from markupsafe import Markup

    text = Path(__file__).with_name("html_page.html").read_text(encoding="utf-8")
    script = text.rpartition("<script>")[2].partition("</script>")[0]
    # All values on the page are escaped, except Markup, which is made of escaped parts.
    template = Environment(autoescape=True).from_string(text)
    base = settings["base"]
    seeds = sorted({row["seed"] for row in rows})
    others = [arm for arm in arms if arm != BASELINE]
    preferred = "legs" if "legs" in others else others[-1] if others else arms[0]
    metrics = {column.label: column.metric for column in COLUMNS if column.metric is not None}
    data = {
        "views": [view._asdict() for view in views],
        "arms": list(arms),
        "left": BASELINE if BASELINE in arms else arms[0],
        "right": preferred,
    }
    scene = settings["scene"]
    return template.render(
        title=f"Losses compared on {scene['name']}",
        subtitle=(
            f"{len(arms)} arms, {len(seeds)} seed(s), {base['iterations']:,} iterations of 3D Gaussian Splatting each, "
            f"on {views[0].width}x{views[0].height} photographs."
        ),
        verdict=too_short(rows) or _verdict(rows, arms, preferred),
        short=too_short(rows),
        scores=scores_table(rows, arms),
        differences=differences_table(rows, others, metrics) if BASELINE in arms and others else None,
        by_iterations=Markup(by_iterations(rows, arms)),
        by_gaussians=[Markup(plot) for plot in by_gaussians(rows, arms)],
        seed=first[arms[0]]["seed"],
        settings=_settings(settings, rows),
        arms=_settings_of_arms(arms, first),
        command=_command(settings, arms, seeds, run),
        data=data,  # as JSON in which no "</script>" ends the element
        script=base64.b64encode(hashlib.sha256(script.encode("utf-8")).digest()).decode("ascii"),
    )


def _verdict(rows: Sequence[Row], arms: Sequence[str], arm: str) -> str:
    """Return the comparison in one sentence: what an arm gains over the baseline, for how many more Gaussians."""
    split = "train" if any(row["metrics"]["test"] is None for row in rows) else "test"
    found = difference(rows, arm, BASELINE, split) if BASELINE in arms and arm != BASELINE else None
    if found is None:
        return "There is nothing to compare yet: train a second arm with the seeds of 3dgs."
    times = times_gaussians(rows, arm, BASELINE)
    cost = "" if times is None else f", with {times:.1f} times the Gaussians"
    where = "on held-out views" if split == "test" else "on training views"
    sentence = f"{arm} has {_in_words(found)} {BASELINE} {where}{cost}"
    equal = difference(rows, f"{arm}@{BASELINE}", BASELINE, split) if f"{arm}@{BASELINE}" in arms else None
    if equal is None:
        return f"{sentence}. At the same number of Gaussians it was not compared: add the arm {arm}@{BASELINE}."
    return f"{sentence}; at the same number of Gaussians it has {_in_words(equal)} it."


def _in_words(found: Difference) -> str:
    amount = f"{abs(found.mean):.2f} dB {'more' if found.mean > 0 else 'less'} PSNR than"
    return amount if found.clear else f"no clear difference in PSNR ({found.mean:+.2f} dB, may be chance) to"


def _settings_of_arms(arms: Sequence[str], first: Mapping[str, Row]) -> List[Dict[str, str]]:
    lines = []
    for arm in arms:
        config = first[arm]["config"]
        spec, threshold = config["spec"], config["densify_grad_threshold"]
        lines.append(
            {
                "arm": arm,
                **{name: spec[name] for name in ("operator", "p", "curve", "beta", "percentile", "normalise")},
                "L1 scale": f"{config['l1_scale']:.4g}",
                "threshold": MISSING if threshold is None else f"{threshold:.4g}",
                "weights": "shuffled" if config.get("shuffled") else "the spec's",
                "numbers of": parse_arm(arm).at or "its own",
            }
        )
    return lines


def _settings(settings: Mapping[str, Any], rows: Sequence[Row]) -> Dict[str, str]:
    base, scene = settings["base"], settings["scene"]
    shared = {
        "scene": f"{scene['name']}: {scene['views']} views, sha256 {scene['sha256']}",
        "proof of the baseline": _proof(settings["baseline"]),
    }
    if "upstream" in settings:  # the other settings are the package's own trainer's
        upstream = {**settings["upstream"], "iterations": base["iterations"]}
        for name, value in upstream.items():
            shared[f"upstream {name}"] = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
    else:
        shared.update({name: str(base[name]) for name in base if name not in ("spec", "seed", "max_gaussians")})
    for name in rows[0]["versions"]:
        versions = sorted({str(row["versions"].get(name)) for row in rows})
        shared[name if name == "machine" else f"version of {name}"] = ", ".join(versions)
    return shared


def _proof(proof: Mapping[str, Any]) -> str:
    if "plain_calls" in proof:
        return f"its L1 was taken {proof['plain_calls']} times, {proof['weighted_calls']} of them weighted"
    return (
        f"over {proof['views']} views its loss is {proof['loss']:.6f}, 3DGS's own {proof['loss_3dgs']:.6f}; "
        f"gradients agree to {proof['gradient_error']:.0e} of the largest"
    )


def _command(settings: Mapping[str, Any], arms: Sequence[str], seeds: Sequence[int], run: Path) -> str:
    base = settings["base"]
    program = ["legs", "compare"] if "upstream" not in settings else ["python", "examples/reproduce_paper/compare.py"]
    words = [*program, settings["path"], *(["CHECKOUT"] if "upstream" in settings else [])]
    words += ["--arms", *(arm for arm in arms if arm != BASELINE), "--seeds", str(seeds[-1] + 1)]
    words += ["--images", settings["images"]] if settings["images"] is not None else []
    trained = settings.get("upstream", base)
    for flag, name in (("-r", "resolution"), ("--iterations", "iterations")):
        words += [flag, str(trained[name])] if trained[name] is not None else []
    if "upstream" in settings:
        words += ["--profile", trained["profile"], *(["--cpu"] if trained["cpu"] else [])]
        words += ["--gaussians", str(trained["gaussians"])] if trained["gaussians"] is not None else []
        words += ["--extra=" + " ".join(map(shlex.quote, trained["extra"]))] if trained["extra"] else []
        return " ".join(shlex.quote(word) for word in [*words, "--out", str(run)])
    words += ["--densify_grad_threshold", f"{base['densify_grad_threshold']!r}", "--out", str(run)]
    return " ".join(shlex.quote(word) for word in words)


def _arms(rows: Sequence[Row], wanted: Optional[Sequence[str]]) -> List[str]:
    there = list(dict.fromkeys(row["arm"] for row in rows))
    order = [BASELINE, "eggs", "legs-l", "legs"]
    if wanted is None:
        return sorted(there, key=lambda arm: (order.index(arm) if arm in order else len(order), arm))
    names = list(dict.fromkeys(parse_arm(arm).name for arm in wanted))
    for name in names:
        if name not in there:
            raise LegsError(f"no row of the arm {name} is trained: there are {', '.join(there)}")
    return names


def _scene_levels(scene: Scene, base: TrainConfig, rows: Mapping[str, Row]) -> Dict[str, Optional[Tensor]]:
    """Return the levels of the training views, for each arm whose weights are normalised over the scene."""
    specs = {arm: TrainConfig.from_dict(row["config"]).weights for arm, row in rows.items()}
    if all(spec.over != "scene" for spec in specs.values()):
        return {}
    unweighted = replace(base, spec="3dgs").weights
    views = load_dataset(scene, unweighted, base.resolution, base.white_background).train
    return {arm: levels_of((view.image for view in views), spec) for arm, spec in specs.items()}


def _views(scene: Scene, wanted: Optional[Sequence[str]]) -> List[View]:
    train, test = split_views(scene)
    if wanted is None:
        candidates = test or train
        count = min(VIEWS, len(candidates))
        return [candidates[(2 * index + 1) * len(candidates) // (2 * count)] for index in range(count)]
    chosen = []
    for part in wanted:
        found = [view for view in [*test, *train] if part in view.name]
        if not found:
            raise LegsError(f"{scene.root}: no view has {part!r} in its name")
        chosen.append(found[0])
    return chosen
