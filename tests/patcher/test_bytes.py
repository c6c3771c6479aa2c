"""legs-patch writes and takes back the same bytes, whatever a file's formatting."""

from __future__ import annotations

import sys
import textwrap

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from legs_adapters.cli import main
from legs_adapters.plan import plan, write
from legs_adapters.report import as_diff
from legs_adapters.undo import undo

from legs_loss.system.terminal import printable
from tests.patcher.support import NAMES, PATCHED, SITE, checkout, expected, files, run_git, snapshot

ONE_FILE = textwrap.dedent(
    """\
    import torch
    from utils.loss_utils import l1_loss
    from gaussian_renderer import render


    def training(scene, gaussians):
        for viewpoint_cam in scene:
            image = render(viewpoint_cam, gaussians, None, None)["render"]
            gt_image = viewpoint_cam.original_image.cuda()
            SITE
            Ll1.backward()
    """
)


WEIGHTED = [name for name in NAMES if "weighted" in dict(expected(files(name)).values())]


@pytest.mark.parametrize("name", WEIGHTED)
def test_undo_gives_back_every_byte(name, tmp_path):
    root = checkout(tmp_path, files(name))
    before = snapshot(root)
    assert write(plan(root))
    assert snapshot(root) != before
    undo(root)
    assert snapshot(root) == before


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text.replace("\n", "\r\n"),
        lambda text: text.rstrip("\n"),
        lambda text: "\ufeff" + text,
        lambda text: "\ufeff" + text.replace("\n", "\r\n").rstrip(),
        lambda text: text.replace("    for", "\tfor").replace("        ", "\t\t"),
        lambda text: "# -*- coding: utf-8 -*-\n# Größe\n" + text,
        lambda text: text.replace("import torch\n", "import os; import torch  # für alle\f\n"),
        lambda text: text + "\n\n\x0c\n# the end\n\n\n",
    ],
    ids=["crlf", "no final newline", "bom", "bom, crlf, no newline", "tabs", "coding", "semicolons", "form feed"],
)
def test_bytes_that_are_not_the_edit_stay(change, tmp_path):
    data = change(ONE_FILE.replace("        SITE\n", SITE)).encode("utf-8")
    root = checkout(tmp_path, {**files("inria"), "train.py": data})
    found = plan(root)
    (path, after), newline = next(iter(found.after.items())), b"\r\n" if b"\r\n" in data else b"\n"
    for edit in sorted(found.edits[path], reverse=True):
        assert after.count(edit.after) >= 1
    assert after.startswith(b"\xef\xbb\xbf") == data.startswith(b"\xef\xbb\xbf")
    assert after.count(newline) == data.count(newline) + 1
    assert after.endswith(data[-10:])
    removed = after.replace(b"import legs_loss" + newline, b"", 1)
    wanted = data.replace(b"Ll1 = l1_loss(image, gt_image)", PATCHED.strip().encode(), 1)
    assert removed == wanted
    write(found)
    undo(root)
    assert (root / "train.py").read_bytes() == data


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_git_applies_the_diff_whatever_ends_the_lines(end, mark, tmp_path):
    data = (mark + ONE_FILE.replace("        SITE\n", SITE)).replace("\n", end).encode("utf-8")
    root = checkout(tmp_path / "root", {**files("inria"), "train.py": data})
    found = plan(root)
    (tmp_path / "diff").write_bytes(printable(as_diff(found.changes()), lines=True).encode("utf-8"))
    run_git(root, "apply", "--whitespace=nowarn", str(tmp_path / "diff"))
    assert (root / "train.py").read_bytes() == found.after["train.py"] != data


SPACES = st.sampled_from(["", " ", "  ", "\n                ", "  # why\n            ", " \\\n            "])


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(SPACES, min_size=6, max_size=6),
    st.sampled_from(["call", "keyword", "abs", "method", "mean", "masked"]),
    st.sampled_from(['"', "'"]),
    st.sampled_from(["\n", "\r\n"]),
    st.booleans(),
)
@example(["\n", "  # why\n            ", "", "", " \\\n            ", ""], "abs", '"', "\r\n", True)
def test_formatting_makes_no_difference(tmp_path, spaces, form, quote, newline, comma):
    a, b, c, d, e, f = (" " if "\n" not in s and "\\" in s else s for s in spaces)
    image, gt = f"pkg[{quote}render{quote}]", "viewpoint_cam.original_image"
    tail = "," if comma else ""
    expressions = {
        "call": f"l1_loss({a}{image}{b},{c}{gt}{d}{tail}{e})",
        "keyword": f"l1_loss({a}network_output={image}{b},{c}gt={gt}{d}{tail}{e})",
        "abs": f"torch.abs({a}{image}{b}-{c}{gt}{d}).mean({e})",
        "method": f"({a}{image}{b}-{c}{gt}{d}).abs({e}).mean({f})",
        "mean": f"torch.mean({a}torch.abs({b}({c}{gt}{d}-{e}{image}{f})))",
        "masked": f"l1_loss({a}{image}[mask]{b},{c}{gt}[mask]{d}{tail}{e})",
    }
    text = ONE_FILE.replace(
        'image = render(viewpoint_cam, gaussians, None, None)["render"]', "pkg = render(viewpoint_cam)"
    )
    text = text.replace("        SITE\n", f"        Ll1 = {expressions[form]}{'' if comma else '  # the term'}\n")
    data = text.replace("\n", newline).encode()
    root = checkout(tmp_path / f"{abs(hash((form, data)))}", {**files("inria"), "train.py": data})
    found = plan(root)
    assert [site.path for site in found.findings.sites] == ["train.py"]
    after = found.after["train.py"]
    namespace = compile(after, "train.py", "exec")
    assert namespace
    here = plan(root, in_place=True).after["train.py"]
    assert here.count(b"\n") == data.count(b"\n")
    assert after.count(b"#") == data.count(b"#"), "a comment was lost"
    call = "".join(after.decode().split("legs_loss.l1_loss(", 1)[1].split("Ll1.backward")[0].split())
    assert call.index("render") < call.index("original_image"), "the rendering comes first"
    write(found)
    undo(root)
    assert (root / "train.py").read_bytes() == data


MASK = "mask = image.sum(0) > 0.5\n        Ll1 = "
SELECTED = 'legs_loss.l1_loss(image, gt_image, reduction="none")[:, mask].mean()'


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("Ll1 = 1 and(image - gt_image).abs().mean()", "Ll1 = 1 and legs_loss.l1_loss(image, gt_image)"),
        ("Ll1 = 1 and(l1_loss)(image, gt_image)", "Ll1 = 1 and(legs_loss.l1_loss)(image, gt_image)"),
        (
            "Ll1 = (  # é\n            l1_loss  # (\n        )(image, gt_image)",
            "Ll1 = (  # é\n            legs_loss.l1_loss  # (\n        )(image, gt_image)",
        ),
        (
            "Ll1 = (torch.nn.  # why\n            L1Loss()(image, gt_image))",
            "Ll1 = (legs_loss.l1_loss(  # why\n            image, gt_image, own=torch.nn. L1Loss()))",
        ),
        (
            "error = abs(image - gt_image)\n        seen = error.detach() > 1\n        Ll1 = 1 and(error).mean()",
            "error = abs(image - gt_image)\n        seen = error.detach() > 1\n"
            '        Ll1 = 1 and(legs_loss.l1_loss(image, gt_image, reduction="none")).mean()',
        ),
        (f"{MASK}l1_loss((image[:, mask]), (gt_image[:, mask]))", MASK + SELECTED),
        (f"{MASK}abs((image[:, mask]) - gt_image[:, (mask)]).mean()", MASK + SELECTED),
        (
            f"{MASK}l1_loss(image[:,  # é\n            mask], gt_image[:, mask])",
            MASK + SELECTED.replace(", gt", "  # é\n            , gt"),
        ),
    ],
)
def test_a_term_is_known_and_written_whatever_its_brackets_and_lines(before, after, tmp_path):
    root = checkout(tmp_path, {**files("inria"), "train.py": ONE_FILE.replace("SITE", before)})
    data = plan(root).after["train.py"].decode()
    assert data.replace("import legs_loss\n", "", 1) == ONE_FILE.replace("SITE", after)
    compile(data, "train.py", "exec")


@pytest.mark.skipif(sys.version_info < (3, 10), reason="what is in an f-string has no place before Python 3.10")
def test_a_term_in_an_f_string_is_written_in_it(tmp_path):
    line = "Ll1 = l1_loss(image, gt_image) + float(f'''\né{l1_loss(image, gt=gt_image)}'''[2:])"
    root = checkout(tmp_path, {**files("inria"), "train.py": ONE_FILE.replace("SITE", line)})
    assert line.replace("l1_loss", "legs_loss.l1_loss").replace("gt=", "") in plan(root).after["train.py"].decode()


def test_brackets_around_a_function_passed_by_name_stay(tmp_path):
    texts, path = files("registered_callable_weighted"), "src/Methods/GaussianThing/Loss.py"
    before, name = '"L1_Color", (  # é\n            ', "torch.nn.functional.l1_loss"
    texts[path] = texts[path].replace(f'"L1_Color", {name}', f"{before}{name})")
    after = plan(checkout(tmp_path, texts)).after[path].decode()
    assert f"{before}lambda input, target: legs_loss.l1_loss(input, target, own={name}))" in after


def test_a_file_with_a_term_in_another_is_left_with_the_reason(tmp_path, capsys):
    line = "Ll1 = l1_loss(image + l1_loss(image, gt_image), gt_image)"
    root = checkout(tmp_path, {**files("inria"), "train.py": ONE_FILE.replace("SITE", line)})
    before = snapshot(root)
    assert main([str(root)]) == 2
    assert "train.py: one term is in another: weight the inner one by hand" in capsys.readouterr().err
    assert snapshot(root) == before


STATEMENTS = st.sampled_from(
    [
        "x = 1\n",
        "import os\n",
        "from __future__ import annotations\n",
        '"""A text."""\n',
        "def f(a, b):\n    return abs(a - b)\n",
        "class A:\n    def l1_loss(self, image, gt_image):\n        return (image - gt_image).abs().mean()\n",
        "def g(render, cam):\n    image = render(cam)['render']\n    l1_loss(image, cam.original_image).backward()\n",
        "def h(m, gaussians):\n    torch.nn.functional.l1_loss(m.render, m.gt_image, reduction='sum').backward()\n",
        "with open('x') as f:\n    pass\n",
        "# only a comment\n",
        "\n",
        "try:\n    import torch\nexcept ImportError:\n    torch = None\n",
        "print('ü', *[i for i in range(3)], sep='\\n')\n",
    ]
)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(STATEMENTS, max_size=8), st.sampled_from(["", "\n"]), st.sampled_from(["\n", "\r\n", "\r"]))
def test_undo_of_a_patch_is_the_file_whatever_the_file(tmp_path, statements, ending, newline):
    future = [text for text in statements if "__future__" in text][:1]
    text = "".join([*future, *(text for text in statements if "__future__" not in text)]).rstrip("\n") + ending
    data = text.replace("\n", newline).encode("utf-8")
    root = checkout(tmp_path / f"{abs(hash(data))}", {"train.py": data})
    found = plan(root)
    if found.after:
        compile(found.after["train.py"], "train.py", "exec")
        write(found)
        undo(root)
    assert (root / "train.py").read_bytes() == data
    assert snapshot(root) == {"train.py": data}
