"""Code that is deep or large: the plan goes on, and files that were not read are reported."""

from __future__ import annotations

import subprocess
import sys
import textwrap

import pytest

from tests.patcher.support import checkout, files, legs_patch
from tests.support import legs_environment

TRAIN = """import torch
from gaussian_renderer import render
from utils.loss_utils import l1_loss


def training(scene, gaussians):
    for cam in scene.getTrainCameras():
        image = render(cam, gaussians, None, None)["render"]
        loss = l1_loss(image, cam.original_image.cuda())
        loss.backward()
"""
STEPS = "its analysis takes more than 3000000 steps"
PARTS = "an expression of more than 2000 parts"
# What stands in another function of the checkout, and why that file is reported as unread, if it is.
CASES = {
    "a sum of 100 parts": ("x = " + " + ".join(["l1_loss(a, b)"] * 100), ""),
    "a sum of 1,000 calls": ("x = " + " + ".join(["loss(a, b)"] * 1000), ""),
    "a sum of 2,000 names": ("x = " + " + ".join(["loss"] * 2000), ""),
    "a string of 400 parts": ("x = " + " ".join(["'l1_loss'"] * 400), ""),
    "400 elif": ("if a == 0:\n    x = 0\n" + "".join(f"elif a == {i}:\n    x = {i}\n" for i in range(1, 400)), ""),
    "1,000 attributes": ("x = a" + ".b" * 1000, ""),
    "1,000 not": ("x = " + "not " * 1000 + "a", ""),
    "100 brackets": ("x = " + "[" * 100 + "]" * 100, ""),
    "190 brackets": ("x = " + "[" * 190 + "]" * 190, "brackets are nested more than 150 deep"),
    "2,000 parentheses": ("x = " + "(" * 2000 + "1" + ")" * 2000, "brackets are nested more than 150 deep"),
    "100,000 open ones": ("x = " + "(" * 100_000, "brackets are nested more than 150 deep"),
    "brackets in a string": ("x = '" + ") (" * 400 + "'", ""),
    "5 MB of literal": ("x = [" + "1.25, " * 900_000 + "]", "larger than 1 MiB"),
    "900 kB of literal": ("x = [" + "1.25, " * 150_000 + "]", STEPS),
    "130,000 statements": ("a\n" * 130_000, ""),
    "8,000 small functions": ("".join(f"def f{i}(a, b):\n    return l1_loss(a, b)\n\n" for i in range(8000)), ""),
    "3,000 trained terms": (
        "def f(a, b):\n" + "    l1 = l1_loss(render(a)['render'], b.original_image); l1.backward()\n" * 3000,
        "",
    ),
    "a sum of 20,000 parts": ("x = " + " + ".join(["l1_loss(a, b)"] * 20_000), PARTS),
    "a loss of 20,000 parts": ("def f():\n    x = " + " + ".join(["l1_loss(a, b)"] * 20_000), PARTS),
    "20,000 attributes": ("x = a" + ".b" * 20_000, PARTS),
    "20,000 calls": ("x = a" + ".b(1, 2)" * 20_000, PARTS),
    "20,000 indices": ("x = a" + "[0]" * 20_000, PARTS),
    "20,000 not": ("x = " + "not " * 20_000 + "a", PARTS),
    "20,000 signs": ("x = " + "-" * 20_000 + "a", PARTS),
    "20,000 strings": ("x = " + " ".join(["'l1_loss'"] * 20_000), PARTS),
    "20,000 choices": ("x = " + "1 if a else " * 20_000 + "1", PARTS),
    "20,000 lambdas": ("x = " + "lambda a, b: " * 20_000 + "1", "is nested too deeply"),
    "20,000 lines": ("x = 1 + \\\n" * 20_000 + "1", PARTS),
    "a field of 20,000 parts": ("x = f'{" + "+".join(["a"] * 20_000) + "}'", PARTS),
    "a list of 10,000 parts": ("x = [" + ", ".join(["-a.b[0]"] * 10_000) + "]", ""),
    "10,000 statements": ("x = -a.b[0]\n" * 10_000, ""),
    "5,000 elif": ("if a == 0:\n    x = 0\n" + "".join(f"elif a == {i}:\n    x = {i}\n" for i in range(5000)), "elif"),
    "400 blocks": ("".join(" " * i + "if a:\n" for i in range(400)) + " " * 400 + "x = 1", "does not parse"),
    "5,000 functions in one": (
        "def f():\n" + "".join(f"    def f{i}(a, b):\n        return l1_loss(a, b)\n\n" for i in range(5000)),
        "",
    ),
    "3,000 terms that nothing trains": ("def step(image, gt):\n" + "    l1_loss(image, gt).backward\n" * 3000, ""),
    "a double byte order mark": ("\ufeff\ufeffl1_loss(a, b)", "does not parse"),
}


def check(root):
    done = legs_patch("--check", root)
    assert "Traceback" not in done.stdout + done.stderr
    return done.returncode, done.stdout + done.stderr


def beside(folder, others):
    shared = {path: content for path, content in files("common").items() if path != "train.py"}
    return checkout(folder, {**shared, "train.py": TRAIN, **others})


@pytest.mark.slow
def test_the_training_is_planned_beside_them(tmp_path):
    """All of them in one checkout: a fault of one file costs only that file."""
    others = {}
    for number, (name, (text, _)) in enumerate(CASES.items()):
        head = "" if name.startswith("a double") else "from utils.loss_utils import l1_loss\n"
        others[f"other{number}.py"] = f"{head}{text}\n"
    code, said = check(beside(tmp_path, others))
    assert code == 1, said
    trained = list(CASES).index("3,000 trained terms")
    assert f"would change: other{trained}.py, train.py" in said
    unread = {line.split()[0]: line.split(None, 3)[3] for line in said.splitlines() if " not read " in line}
    for number, (name, (_, why)) in enumerate(CASES.items()):
        found = unread.get(f"other{number}.py", "")
        assert (why in found) if why else not found, (name, found)


def test_files_that_are_too_much_together(tmp_path, monkeypatch, capsys):
    """Bytes: an error. Steps: the first that go over, each is one line."""
    from legs_adapters.cli import main
    from legs_adapters.code import limits
    from legs_adapters.code import sources as read

    head = "from utils.loss_utils import l1_loss\n"
    others = {f"{name}.py": head + "x = 1\n" * size for name, size in (("a", 900), ("z", 800), ("m", 20))}
    root = beside(tmp_path, others)

    def unread():
        assert main(["--check", str(root)]) == 1
        said = capsys.readouterr().out
        assert "would change: train.py" in said
        return {line.split()[0]: line.split("not read  ")[1] for line in said.splitlines() if " not read " in line}

    assert not unread()
    with monkeypatch.context() as patch:
        patch.setattr(read, "MAX_BYTES", 5000)
        assert main(["--check", str(root)]) == 2
        assert " MiB: leave some out by --exclude" in capsys.readouterr().err
    with monkeypatch.context() as patch:
        patch.setattr(limits, "MAX_FILE_STEPS", 20_000)
        assert sorted(unread()) == ["a.py", "z.py"]
    with monkeypatch.context() as patch:
        patch.setattr(limits, "MAX_STEPS", 30_000)
        found = unread()
    assert "z.py" in found and "a.py" not in found
    assert "all files together take more than" in found["z.py"] and "leave others out by --exclude" in found["z.py"]


SUM = "    image = render(cam, gaussians)['render']\n    gt = cam.original_image\n    loss = {}\n    loss.backward()\n"


def loops(depth):
    """Return a training step in so many loops."""
    heads = "".join(f"    {' ' * i}for x{i} in scene:\n" for i in range(depth))
    return "def f(scene, cam, gaussians):\n" + heads + textwrap.indent(SUM.format("l1_loss(image, gt)"), " " * depth)


def step(body, name="f"):
    """Return a training step with a body between the two images and their loss."""
    lines = SUM.format("l1_loss(image, gt)").splitlines(True)
    return f"def {name}(cam, gaussians, c):\n" + "".join([*lines[:2], textwrap.indent(body, "    "), *lines[2:]])


# What once was exponential, cubic, or took 500 MB; and whether the file is read.
LABORIOUS = {
    "20 loops": (loops(20), True),
    "95 loops": (loops(95), False),  # Python compiles 20
    "a sum of 100 terms": ("def f(cam, gaussians):\n" + SUM.format(" + ".join(["l1_loss(image, gt)"] * 100)), True),
    "a sum of 601 terms": ("def f(cam, gaussians):\n" + SUM.format(" + ".join(["l1_loss(image, gt)"] * 601)), True),
    "650 lambdas": ("def f():\n    g = " + "lambda: " * 650 + "0\n", True),
    "1,500 lambdas": ("def f():\n    g = " + "lambda: " * 1500 + "0\n", sys.version_info >= (3, 9)),
    "1,000 functions": ("".join(f"def f{i}(a, b):\n    return l1_loss(a, b)\n\n" for i in range(1000)), True),
    "9,000 functions": ("".join(f"def f{i}(a, b):\n    return l1_loss(a, b)\n\n" for i in range(9000)), True),
    "400 branches": (step("if c:\n    image = image * gt\nelse:\n    gt = gt + image\n" * 400), True),
    "1,800 loops": (step("for x in c:\n    image = image + gt\n" * 1800), True),
    "1,200 try": (step("try:\n    image = image + gt\nexcept ValueError:\n    gt = image\n" * 1200), True),
    "2,520 functions": ("".join(step("", f"f{i}") for i in range(2520)), True),
    "names for names": ("a0 = l1_loss\n" + "".join(f"a{i + 1} = a{i} if x else a{i}\n" for i in range(60)), True),
}


# Of what takes seconds, the harder of both ways: --ssim and --masks read all that is read without them.
LONG = {"1,000 functions", "1,800 loops", "1,200 try", "2,520 functions"}


@pytest.mark.parametrize(
    ("what", "options"),
    [
        pytest.param(what, options, marks=[pytest.mark.slow] * (what in LONG and not options), id=f"{what}-{options}")
        for what in LABORIOUS
        for options in ("", "ssim=True, masks=True")
    ],
)
def test_the_steps_are_few(what, options, tmp_path):
    """Steps are counted, not timed: the same files are read on any machine, in little memory."""
    text, is_read = LABORIOUS[what]
    head = "from gaussian_renderer import render\nfrom utils.loss_utils import l1_loss\n\n\n"
    script = (
        f"import pathlib, re, sys\nfrom legs_adapters.plan import plan\nfound = plan(sys.argv[1], {options})\n"
        "print(sorted(one.path for one in found.findings.unreadable), sorted(found.after))\n"
        "status = pathlib.Path('/proc/self/status')\n"  # getrusage would count what pytest itself takes
        "print(re.search(r'VmHWM:\\s+(\\d+)', status.read_text()).group(1) if status.exists() else 0)\n"
    )
    root = beside(tmp_path, {"other.py": head + text})
    done = subprocess.run(
        [sys.executable, "-c", script, str(root)], stdout=subprocess.PIPE, env=legs_environment(), timeout=100
    )
    said, kilobytes = done.stdout.decode().splitlines()
    assert said.startswith("[]" if is_read else "['other.py']") and "'train.py'" in said
    assert int(kilobytes) < 300 << 10


def test_many_files_cost_what_each_costs(tmp_path):
    """Ten copies of a checkout: ten times the steps."""
    from legs_adapters.plan import plan

    unlike = "".join(f"def tool{i}(a, b):\n    return np.abs(a * {i}) + run(a, 'train', b)\n\n\n" for i in range(50))
    texts = {"train.py": TRAIN, "utils/tools.py": unlike, **{k: v for k, v in files("common").items() if "/" in k}}

    def steps(copies):
        root = tmp_path / str(copies)
        found = plan(checkout(root, {f"c{i}/{path}": text for i in range(copies) for path, text in texts.items()}))
        assert len(found.after) == copies
        return found.findings.program.budget._of_all[0]

    one = steps(1)
    assert 9 * one <= steps(10) <= 10.5 * one


def test_submodules_are_planned_under_the_one_budget(tmp_path, monkeypatch, capsys):
    from legs_adapters.cli import main
    from legs_adapters.code import limits

    root = beside(tmp_path, {"third_party/gs/train.py": TRAIN + "# gaussian splatting\n"})
    assert main(["--check", str(root)]) == 1
    assert "third_party/gs/train.py:9 may be the loss" in capsys.readouterr().err
    monkeypatch.setattr(limits, "MAX_STEPS", 2_000)
    assert main(["--check", str(root)]) == 1
    assert "third_party/gs/train.py:1 may be the loss" in capsys.readouterr().err  # unread, and said


STATEMENTS = {
    "assignment": "image = image + gt\n",
    "annotated": "image: object = gt * image\n",
    "augmented": "image += gt\n",
    "unpacked": "image, gt = gt, image\n",
    "attribute": "c.image = image\nimage = c.image\n",
    "entry": "c['image'] = image\nimage = c['image']\n",
    "call": "image = torch.clamp(image, 0, 1)\n",
    "append": "c.append(image)\nimage = torch.stack(c)\n",
    "in place": "image.mul_(gt)\n",
    "index": "image = image[gt > 0]\n",
    "mask": "image = image * mask\nmask = image > 0\n",
    "choice": "image = image if c else gt\n",
    "comprehension": "image = [each * gt for each in image]\n",
    "lambda": "gt = (lambda each: each + image)(gt)\n",
    "delete": "del c\nc = image\n",
    "assert": "assert image is not gt\n",
    "global": "global image\nimage = gt\n",
    "import": "import image\nimage = image.of(gt)\n",
    "with": "with c as image:\n    gt = image\n",
    "if": "if c:\n    image = image * gt\nelse:\n    gt = gt + image\n",
    "if alone": "if c:\n    image = torch.cat([image, gt])\n",
    "for": "for x in c:\n    image = image + gt\n",
    "for else": "for image in gt:\n    if c:\n        break\nelse:\n    gt = image\n",
    "while": "while c:\n    image = image + gt\n    continue\n",
    "try": "try:\n    image = image + gt\nexcept ValueError:\n    gt = image\nfinally:\n    c = gt\n",
    "raise": "if c:\n    raise ValueError(image)\n",
    "return": "if c:\n    return image\n",
    "function": "def image(x):\n    return gt + image(x)\n",
    "class": "class image:\n    gt = image\n",
    "loss": "loss = l1_loss(image, gt)\nloss.backward()\n",
}


def nested(statement, depth):
    """Return a compound statement in itself, so many deep."""
    text = statement
    for _ in range(depth - 1):
        head, _, rest = statement.partition("\n")
        text = head + "\n" + textwrap.indent(text, "    ") + rest + "\n"
    return text


@pytest.mark.parametrize("options", [{}, {"ssim": True, "masks": True}], ids=["plain", "ssim and masks"])
@pytest.mark.parametrize("what", STATEMENTS, ids=lambda what: what.replace(" ", "_"))
def test_the_steps_grow_with_the_code(what, options, tmp_path, monkeypatch):
    """Every call of a function counts, and there are not many of them for a step of the budget."""
    from legs_adapters.code.limits import Budget
    from legs_adapters.plan import plan

    statement, spent, calls = STATEMENTS[what], [0], [0]
    spend = Budget.spend
    monkeypatch.setattr(Budget, "spend", lambda self, path, n: spent.append(spent.pop() + n) or spend(self, path, n))

    def count(frame, event, argument):
        calls[0] += event == "call"

    def cost(body):
        head = "import torch\nfrom gaussian_renderer import render\nfrom utils.loss_utils import l1_loss\n\n\n"
        (tmp_path / "train.py").write_text(head + step("for cam in c:\n" + textwrap.indent(body, "    ")))
        spent[0] = calls[0] = 0
        sys.setprofile(count)
        try:
            plan(tmp_path, **options)
        finally:
            sys.setprofile(None)
        most = 12 if sys.version_info >= (3, 8) else 16  # asttokens looks at each node, too
        assert calls[0] < most * spent[0]  # none is a walk that nobody counts
        return spent[0], calls[0]

    cost(statement)  # what is remembered of words
    shapes = {"in sequence": [statement * n for n in (20, 40)]}
    if statement.count(":\n    ") == 1 and "else" not in statement:
        shapes["nested"] = [nested(statement, n) for n in (5, 10)]
    for shape, (less, more) in shapes.items():
        for once, twice in zip(cost(less), cost(more)):
            assert twice <= 2.5 * once, (shape, once, twice)


MIB = 1 << 20
# Texts that nobody has to parse, each of a size that is read: a search from each of their words or quotes to the end
# takes from a minute to hours.
TEXTS = {
    "quotes.py": "\\'''" + "x" * 30 + "\n",
    "quotes_in_a_line.py": '\\"x',
    "a_word.py": "lossmask",
    "open_brackets.py": "loss[",
    "calls_in_a_line.py": "eval(",
    "blanks.py": "  ",
    "annotations.py": "l1:",
    "words.py": "l1loss",
    "dots.py": ".l1",
    "comments_in_a_line.py": "#,",
    "weighted.py": "legs_loss.ssim;",
    "a.yaml": "loss: {",
    ".gitmodules": "\n",
}


@pytest.mark.parametrize("command", ["--check", "--undo"])
def test_long_texts_are_searched_once(command, tmp_path):
    texts = {}
    for name, text in TEXTS.items():
        head, size = (
            ("x = l1_loss(image, gt)\n", MIB) if name.endswith(".py") else ("", MIB if "git" in name else 1 << 17)
        )
        texts[name] = (head + text * (size // len(text)))[:size]
    root = checkout(tmp_path, texts)
    done = subprocess.run(
        [sys.executable, "-m", "legs_adapters.cli", command, str(root)],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=legs_environment(), timeout=300,
    )  # fmt: skip
    assert (done.returncode, b"Traceback" in done.stdout) == (2, False), done.stdout


def test_deeper_than_the_stack(tmp_path, monkeypatch):
    """Code within the limits that the walk still cannot follow costs only its own file."""
    from legs_adapters import plan as module
    from legs_adapters.rules import find

    def entries(self, function):
        if function.module.path == "other.py":
            raise RecursionError
        return self._as_before(function)

    monkeypatch.setattr(find._Search, "_as_before", find._Search._entries, raising=False)
    monkeypatch.setattr(find._Search, "_entries", entries)
    other = "from utils.loss_utils import l1_loss\nx = l1_loss(a, b)\n"
    found = module.plan(beside(tmp_path, {"other.py": other}))
    assert [(one.path, one.reason) for one in found.findings.unreadable] == [("other.py", "is nested too deeply")]
    assert list(found.after) == ["train.py"]


@pytest.mark.slow
@pytest.mark.parametrize("what", ["5,000 functions", "200 copies of train.py"])
def test_many(what, tmp_path):
    """Their time is in benchmarks; that they end, and how, is here."""
    if what == "5,000 functions":
        text = "".join(f"def f{i}(a, b):\n    x = l1_loss(a, b)\n    return x\n\n" for i in range(5000))
        others = {"other.py": f"from utils.loss_utils import l1_loss\n{text}"}
    else:
        others = {f"train{i}.py": TRAIN for i in range(200)}
    code, said = check(beside(tmp_path, others))
    assert (code, "not read" in said) == (1, False)
