"""The expression that a trace means on a line of several: by the columns of its stack, from Python 3.11 on."""

from __future__ import annotations

import pytest
from legs_adapters.plan import plan
from legs_adapters.terms.traced import Frame, Trace, Traced

from tests.patcher.support import checkout, files

PHOTOGRAPH = {"path": "images/{0}.png", "correlation": 1.0, "is_photograph": True, "detail": 1.0}
NORMALS = {**PHOTOGRAPH, "path": "normals/{0}.png", "is_photograph": False}
HEAD = """
import torch
from torch.nn.functional import l1_loss, mse_loss

def mae(a, b):
    return (a - b).abs().mean()

ways = {"l1": mae, "l2": mse_loss}

"""
END = """
    loss.backward()
    optimizer.step()
"""


def at(code, expression, name="step", sides=("", "")):
    """Return the frame that is at an expression of the code."""
    start = code.index(expression)
    line, begin = code[:start].count("\n") + 1, start - code.rfind("\n", 0, start) - 1
    last = line + expression.count("\n")
    end = len(expression) - expression.rfind("\n") - 1 if last > line else begin + len(expression)
    return Frame("train.py", line, (last, begin, end), name, sides)


def term(*frames, match=PHOTOGRAPH, kind="l1", largest=1.0):
    """Return a term with a stack, whose second side is a photograph, or what another match says."""
    return Traced(frames, kind, 1, (3, 32, 48), largest, 0.5, match, True, False, 300, (), (), 8, 0, True)


def found(folder, step, *stacks, columns=True):
    """Return code, sites, problems and skipped lines of a step by a trace: of each stack its kind, match and frames."""
    code = HEAD + f"def step(image, gt, normal, ref):{step}{END}"
    (folder / "train.py").write_text(code, encoding="utf-8")
    terms = []
    for kind, match, *places in stacks:
        frames = [place if isinstance(place, tuple) else (place,) for place in places]
        frames = [at(code, *each) for each in frames]
        frames = frames if columns else [frame._replace(span=()) for frame in frames]
        terms.append(term(*frames, kind=kind, match=match))
    findings = plan(folder, trace=Trace(terms, frozenset())).findings
    lines = code.splitlines()
    sites = [(lines[site.line - 1][site.column :]) for site in findings.sites]
    return sites, findings.problems, [left.line for left in findings.left]


BODY = ("(a - b)", "mae", ("a", "b"))


def test_of_a_line_the_term_that_ran_is_weighted_and_not_the_first(tmp_path):
    step = "\n    loss = l1_loss(normal, ref) if step is None else l1_loss(image, gt)"
    sites, problems, _ = found(tmp_path, step, ("l1", PHOTOGRAPH, "l1_loss(image, gt)"))
    assert (sites, problems) == (["l1_loss(image, gt)"], [])


@pytest.mark.parametrize("kind", ["l1", "squared"])
def test_two_terms_on_a_line_are_told_apart(tmp_path, kind):
    step = "\n    loss = (normal - ref).abs().mean(); loss = loss + l1_loss(image, gt)"
    stacks = [(kind, NORMALS, "normal - ref"), ("l1", PHOTOGRAPH, "l1_loss(image, gt)")]
    sites, problems, _ = found(tmp_path, step, *stacks)
    assert (sites, problems) == (["l1_loss(image, gt)"], [])


def test_two_photometric_terms_on_a_line_are_both_weighted(tmp_path):
    step = "\n    loss = l1_loss(image, gt) + l1_loss(normal, gt)"
    stacks = [("l1", PHOTOGRAPH, f"l1_loss({name}, gt)") for name in ("image", "normal")]
    sites, problems, _ = found(tmp_path, step, *stacks)
    assert (sites, problems) == (["l1_loss(image, gt) + l1_loss(normal, gt)", "l1_loss(normal, gt)"], [])


def test_two_calls_of_one_function_on_a_line_are_told_apart(tmp_path):
    step = "\n    loss = mae(normal, ref) + mae(image, gt)"
    stacks = [("l1", NORMALS, BODY, "mae(normal, ref)"), ("l1", PHOTOGRAPH, BODY, "mae(image, gt)")]
    sites, problems, _ = found(tmp_path, step, *stacks)
    assert (sites, problems) == (["mae(image, gt)"], [])


def test_a_call_in_a_further_argument_is_not_the_terms(tmp_path):
    step = "\n    loss = l1_loss(image, gt, weight=mae(normal, gt))"
    sites, _, _ = found(tmp_path, step, ("l1", PHOTOGRAPH, BODY, "mae(normal, gt)"))
    assert sites == ["mae(normal, gt))"]


def test_a_call_that_leads_to_torchs_squared_loss_too_is_not_weighted(tmp_path):
    step = "\n    loss = sum(ways[name](image, gt) for name in ways)"
    call = ("ways[name](image, gt)", "<genexpr>")
    around = "sum(ways[name](image, gt) for name in ways)"
    stacks = [("l1", PHOTOGRAPH, BODY, call, around), ("squared", PHOTOGRAPH, call, around)]
    sites, problems, _ = found(tmp_path, step, *stacks)
    assert (sites, problems) == (["(a - b).abs().mean()"], [])


def test_a_lambda_stands_in_the_innermost_function_around_it_and_in_no_earlier_one(tmp_path):
    step = "\n    loss = way(image, gt)\nway = lambda x, y: torch.abs(x - y).mean()\ndef train(loss):"
    sites, problems, _ = found(tmp_path, step, ("l1", PHOTOGRAPH, ("x - y", "<lambda>", ("x", "y")), "way(image, gt)"))
    assert (sites, problems) == (["torch.abs(x - y).mean()"], [])


def test_without_columns_a_line_of_several_is_quoted(tmp_path):
    """Before Python 3.11, and with -X no_debug_ranges."""
    step = "\n    loss = l1_loss(normal, ref) if step is None else l1_loss(image, gt)"
    sites, problems, _ = found(tmp_path, step, ("l1", PHOTOGRAPH, "l1_loss(image, gt)"), columns=False)
    assert sites == [] and "no call or difference of them alone is there" in problems[0].reason


def test_without_columns_a_line_of_one_is_weighted(tmp_path):
    step = "\n    loss = 0.8 * l1_loss(image.detach(), gt)"
    sites, problems, _ = found(tmp_path, step, ("l1", PHOTOGRAPH, "l1_loss(image.detach(), gt)"), columns=False)
    assert (sites, problems) == (["l1_loss(image.detach(), gt)"], [])


def test_braces_in_the_name_of_a_file_are_said_as_they_are():
    assert "gt is images/{0}.png" in term(at("a - b", "a - b")).text("gt")
    assert "gt is normals/{0}.png, no photograph" in term(at("a - b", "a - b"), match=NORMALS).text("gt")


def test_a_photograph_that_legs_loss_would_refuse_is_quoted(tmp_path):
    frame, step = at("l1_loss(image, gt)", "l1_loss(image, gt)"), "def step(image, gt):\n    loss = l1_loss(image, gt)"
    (tmp_path / "train.py").write_text(f"{step}{END}", encoding="utf-8")
    trace = Trace([term(frame._replace(line=2, span=(2, 11, 29)), largest=241.0)], frozenset())
    findings = plan(tmp_path, trace=trace).findings
    (problem,) = findings.problems
    assert findings.sites == [] and problem.reason.endswith("its values go up to 241")
    assert problem.advice == "bring both pictures to [0, 1] before it"


@pytest.mark.parametrize("largest", [1.0, 241.0])
def test_so_is_one_of_a_function_that_is_passed_by_its_name(tmp_path, largest):
    root = checkout(tmp_path, files("l1_function_as_value_weighted"))
    call = at((root / "train.py").read_text(encoding="utf-8"), "loss_fn(image, gt_image)", "training")
    findings = plan(root, trace=Trace([term(call, largest=largest)], frozenset())).findings
    sites, quoted = (
        [each.line for each in some if each.path == "train.py"] for some in (findings.sites, findings.problems)
    )
    assert (len(sites), quoted) == ((1, []) if largest == 1 else (0, [call.line]))


@pytest.mark.parametrize("is_alone", [True, False])
def test_a_photographs_difference_is_said_where_no_absolute_one_is_seen(tmp_path, is_alone):
    step = "\n    loss = (image - gt).relu().mean()\n    loss += mae(image, gt)"
    absolute = ("l1", PHOTOGRAPH, BODY, "mae(image, gt)")
    _, _, left = found(tmp_path, step, ("signed", PHOTOGRAPH, "image - gt"), *[absolute] * (not is_alone))
    assert (HEAD.count("\n") + 2 in left) == is_alone


def test_a_function_that_is_not_looked_into_is_not_said_to_be_no_l1():
    text = term(at("a - b", "a - b"), kind="compiled: Fused").text("gt")
    assert text.endswith("compiled: Fused, not looked into")


def test_one_line_that_two_ways_lead_to_is_quoted_once(tmp_path):
    step = "\n    loss = step(image)(*[image, gt])"
    stacks = [("l1", PHOTOGRAPH, "step(image)(*[image, gt])", way) for way in ("mae", "mse_loss")]
    sites, problems, _ = found(tmp_path, step, *stacks)
    assert sites == [] and len(problems) == 1
