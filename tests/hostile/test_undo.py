"""Undo after anything: journals are read as written, formatted files restored, what stays weighted keeps its own."""

from __future__ import annotations

import ast
import base64
import json
import re
import signal
import subprocess
import sys
import zlib

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from legs_adapters import journal as journals
from legs_adapters.cli import main
from legs_adapters.code import limits
from legs_adapters.journal import JOURNAL, Journal, Layer
from legs_adapters.plan import plan, write
from legs_adapters.terms.text import Edit
from legs_adapters.undo import undo

from legs_loss import LegsError
from tests.patcher.support import NAMES, PATCHED, SITE, checkout, files, options, snapshot

TEXTS = st.text(st.sampled_from("ab \n\r\t[]{}\"'\\#é\u2028\U0001f600\0"), max_size=60)


@st.composite
def layers(draw):
    original = draw(TEXTS).encode()
    ends = sorted(draw(st.lists(st.integers(0, len(original)), max_size=6)))
    whole = [at for at in ends if original[at : at + 1] < b"\x80"]
    edits = [Edit(a, b, draw(TEXTS).encode()) for a, b in zip(whole[::2], whole[1::2])]
    return Layer(original, sorted(edits))


@settings(max_examples=150, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    added=st.lists(st.tuples(st.sampled_from(["a.py", "b/c.py", "train.txt", "../d.py"]), layers()), max_size=9),
    limits=st.tuples(st.integers(1, 40), st.integers(1, 4), st.integers(10, 500)),
)
def test_what_can_be_written_is_read_back(added, limits, tmp_path_factory):
    root = tmp_path_factory.mktemp("checkout")
    kept = Journal({}, {"legs.toml": [b"", "é".encode()]})
    with pytest.MonkeyPatch.context() as patch:
        for name, value in zip(("MAX_EDITS", "MAX_LAYERS", "MAX_BYTES"), limits):
            patch.setattr(journals, name, value)
        for path, layer in added:
            kept.add(path, layer)
        try:
            data = kept.dump()
        except LegsError:
            return
        (root / JOURNAL).write_bytes(data)
        again = Journal.read(root)
    assert (again.files, again.created) == (kept.files, kept.created)


class TestJournalsThatUndoReads:
    def test_120_000_brackets_in_a_comment(self, tmp_path):
        term = SITE.replace("(image, gt_image)", "(image, # " + "[" * 120_000 + "\n            gt_image)")
        root = checkout(tmp_path, {**files("inria"), "train.py": files("inria")["train.py"].replace(SITE, term)})
        before = snapshot(root)
        write(plan(root))
        assert "legs_loss.l1_loss" in (root / "train.py").read_text()
        undo(root)
        assert snapshot(root) == before

    def test_a_patch_of_what_git_took_back_101_times(self, tmp_path):
        root = checkout(tmp_path, files("inria"))
        before, original = snapshot(root), (root / "train.py").read_bytes()
        plans = []
        for night in range(101):  # every other one upstream has another version
            (root / "train.py").write_bytes(original + b"# new\n" * (night % 2))
            plans += [plan(root)] if night < 2 else []
            assert "train.py" in write(plans[night % 2])
        assert len(Journal.read(root).files["train.py"]) == 1
        undo(root)
        assert snapshot(root) == before

    def test_what_would_be_too_large_to_read_is_not_written(self, tmp_path, monkeypatch):
        texts = files("inria")
        line = (
            texts["train.py"].splitlines().index("            l1_test += l1_loss(image, gt_image).mean().double()") + 2
        )
        root = checkout(tmp_path, texts)
        write(plan(root))
        before = snapshot(root)
        monkeypatch.setattr(journals, "MAX_BYTES", 2 * len(texts["train.py"]))
        with pytest.raises(LegsError, match=r"could not be read again .* so nothing was written"):
            write(plan(root, by_hand=[("train.py", line)]))
        assert snapshot(root) == before
        undo(root)
        assert (root / "train.py").read_text() == texts["train.py"]


def crlf(text):
    return text.replace("\n", "\r\n")


def tabs(text):
    return re.sub(r"^(?:    )+", lambda found: "\t" * (len(found.group()) // 4), text, flags=re.M)


def split(text):
    """Split every call of two names over lines, with a comma behind the last, as formatters do."""
    return re.sub(r"(?m)^((?!.*#).*l1_loss)\((\w+), (\w+)\)", r"\1(\n            \2,\n            \3,\n        )", text)


def unquoted(text):
    return re.sub(r"'([^'\"\n\\#]*)'", r'"\1"', text)


def ruff(text, width="50"):
    command = [sys.executable, "-m", "ruff", "format", "--isolated", "--line-length", width, "-"]
    return subprocess.run(command, input=text.encode(), stdout=subprocess.PIPE, check=True).stdout.decode()


FORMATS = {each.__name__: each for each in (crlf, tabs, split, unquoted)}


@pytest.mark.parametrize("how", FORMATS)
@pytest.mark.parametrize("name", [name for name in NAMES if name.endswith(("weighted", "call", "masked", "fused"))])
def test_a_formatted_file_is_restored(name, how, tmp_path):
    """The formatted patch, undone, is the tree of the formatted original."""
    check_restored(name, FORMATS[how], tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_file_that_ruff_formatted_is_restored(name, tmp_path):
    check_restored(name, ruff, tmp_path)


def check_restored(name, formatted, folder):
    texts = files(name)
    root = checkout(folder, texts)
    if not write(plan(root, **options(name))):
        return
    for path in root.rglob("*.py"):
        path.write_bytes(formatted(path.read_bytes().decode()).encode())
    assert undo(root, force=True)[1] == []
    assert not (root / JOURNAL).exists()
    for path, text in texts.items():
        if path.endswith(".py"):
            assert ast.dump(ast.parse((root / path).read_bytes())) == ast.dump(ast.parse(formatted(text).encode())), (
                path
            )


@pytest.mark.parametrize("first", ["outer", "nested"])
def test_another_checkout_s_journal_is_named(first, tmp_path, capsys):
    """A nested checkout is undone where it was patched: from there, and from the other one, the command is said."""
    texts = {f"method/{name}": text for name, text in files("inria").items()}
    root = checkout(tmp_path / "framework", {**texts, "main.py": "x = 1\n"})
    (root / "method" / ".git").mkdir()
    before = snapshot(root)
    patched, other = (root, root / "method") if first == "outer" else (root / "method", root)
    assert main([str(patched)]) == 0
    whole = snapshot(root)
    capsys.readouterr()
    assert main(["--undo", str(other)]) == 2
    said = capsys.readouterr().err
    assert f"{other}: nothing to undo" in said
    assert f"the journal is in {patched}: legs-patch --undo {patched}" in said
    assert "no journal names it" not in said
    assert snapshot(root) == whole
    assert main(["--undo", str(patched)]) == 0
    assert snapshot(root) == before


CALL = "legs_loss.l1_loss({})"
# Of n edits or calls: the original, the edits, the file now. Each once took the square of n steps, or does.
LABORIOUS = {
    "equal words": lambda n: ("x\n", [(0, 1, "legs_loss")], CALL[:-3] * n),
    "calls in one another": lambda n: ("x\n", [(0, 1, "legs_loss")], "legs_loss(" * n + ")" * n),
    "edits in a row": lambda n: ("x" * n, [(i, i + 1, "legs_loss.a ") for i in range(n)], "legs_loss.ssim()\n" * n),
    "edits that do not end": lambda n: (
        "x\n" * n, [(2 * i, 2 * i + 1, CALL[:-3]) for i in range(n)], CALL.format("") * n
    ),
    "one long call": lambda n: ("x\n", [(0, 1, CALL.format("a " * 3 * n))], f"{CALL.format('')}\n" * n),
    "equal calls": lambda n: (
        "x\n" * n, [(2 * i, 2 * i + 1, CALL.format("a")) for i in range(n)], f"#\n{CALL.format('a')}\n" * n
    ),
    "line breaks": lambda n: ("x\n", [(0, 1, CALL.format("a," + "\n" * n + "b"))], CALL.format("a," + "\n" * n)),
    "words and no end": lambda n: ("x\n", [(0, 1, "legs_loss " * n + "a")], "legs_loss " * n),
    "different calls": lambda n: (
        "x\n" * n, [(2 * i, 2 * i + 1, CALL.format(i)) for i in range(n)], CALL.format("a") * n
    ),
}  # fmt: skip


@pytest.mark.skipif(not hasattr(signal, "alarm"), reason="needs a clock that ends it")
@pytest.mark.parametrize("share", [10, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize("what", LABORIOUS, ids=lambda what: what.replace(" ", "_"))
def test_a_journal_of_much_work_ends(what, share, tmp_path, monkeypatch, capsys):
    """A stranger's: it is done, or its file stays, with the reason, after some seconds; a tenth of it sooner."""
    monkeypatch.setattr(limits, "MAX_FILE_STEPS", limits.MAX_FILE_STEPS // share)
    original, edits, now = LABORIOUS[what](45_000 // share)
    packed = base64.b64encode(zlib.compress(original.encode())).decode()
    layer = {"edits": edits, "original": packed}
    texts = {"train.py": now, JOURNAL: json.dumps({"version": 2, "created": {}, "files": {"train.py": [layer]}})}
    root = checkout(tmp_path, texts)
    signal.alarm(100)  # a search that is not counted would take hours
    try:
        code = main(["--undo", "--force", str(root)])
    finally:
        signal.alarm(0)
    said = capsys.readouterr().out
    if what in ("equal words", "calls in one another", "edits that do not end", "equal calls"):
        assert (code, said) == (0, "restored train.py\n")
    else:
        assert code == 1 and "kept train.py: it was edited since, and " in said
        is_counted = what in ("different calls", "words and no end", "one long call")
        assert ("looking for the patched lines takes too long" in said) is is_counted
        assert (tmp_path / "train.py").read_text() == now


class TestWhatStaysWeighted:
    def test_keeps_its_journal_and_settings(self, tmp_path, capsys):
        root = checkout(tmp_path, files("inria"))
        original = (root / "train.py").read_text()
        assert main([str(root)]) == 0
        edited = (
            (root / "train.py").read_text().replace(PATCHED, PATCHED.replace("(image, gt_image)", "(gt_image, image)"))
        )
        (root / "train.py").write_text(edited)
        before = snapshot(root)
        capsys.readouterr()
        for _ in range(2):
            assert main(["--undo", "--force", str(root)]) == 1
            said = capsys.readouterr()
            assert "Ll1 = legs_loss.l1_loss(gt_image, image)" in said.out
            assert "put back line 66: Ll1 = l1_loss(image, gt_image)" in re.sub(
                r"line \d+: Ll1 = l1", "line 66: Ll1 = l1", said.out
            )
            assert "stay: put those lines back" in said.err and "restored" not in said.out
            assert snapshot(root) == before
        by_hand = edited.replace(PATCHED.replace("(image, gt_image)", "(gt_image, image)"), SITE)
        (root / "train.py").write_text(by_hand)
        assert main(["--undo", "--force", str(root)]) == 0
        assert (root / "train.py").read_text() == original
        assert not (root / "legs.toml").exists() and not (root / JOURNAL).exists()

    def test_other_files_are_restored_once(self, tmp_path):
        texts = files("gui_train_step_weighted")
        root = checkout(tmp_path, texts)
        wrote = [name for name in write(plan(root)) if name.endswith(".py")]
        first, *others = wrote
        text = (root / first).read_text()
        (root / first).write_text(re.sub(r"legs_loss\.l1_loss\((\w+)", r"legs_loss.l1_loss(0 + \1", text))
        changes, kept = undo(root, force=True)
        assert (sorted(changes), [name for name, _ in kept]) == (sorted(others), [first])
        assert list(Journal.read(root).files) == [first]

    def test_a_changed_argument_in_brackets_is_an_edit(self, tmp_path):
        """Words are the same there; the tree is another."""
        line = "        Ll1 = l1_loss((image + 1) * 2, gt_image)\n"
        text = files("inria")["train.py"].replace(SITE, line)
        root = checkout(tmp_path, {**files("inria"), "train.py": text})
        write(plan(root))
        now = (root / "train.py").read_text()
        assert "legs_loss.l1_loss((image + 1) * 2" in now
        (root / "train.py").write_text(now.replace("(image + 1) * 2", "image + (1 * 2)"))
        assert [name for name, _ in undo(root, force=True)[1]] == ["train.py"]

    def test_a_file_that_was_moved_keeps_its_journal(self, tmp_path, capsys):
        root = checkout(tmp_path, files("inria"))
        before = snapshot(root)
        assert main([str(root)]) == 0
        (root / "train.py").rename(root / "train_mine.py")
        patched = snapshot(root)
        for force in ([], ["--force"]):
            capsys.readouterr()
            assert main(["--undo", *force, str(root)]) == 1
            said = capsys.readouterr().out
            assert "kept train.py: the file is gone: put it back, undo, and move it again" in said
            assert "kept train_mine.py: no journal names it" in said
            assert snapshot(root) == patched
        (root / "train_mine.py").rename(root / "train.py")
        assert main(["--undo", str(root)]) == 0
        assert snapshot(root) == before

    def test_a_patch_whose_journal_is_gone_is_named(self, tmp_path, capsys):
        root = checkout(tmp_path, files("inria"))
        assert main([str(root)]) == 0
        for name in (JOURNAL, "legs.toml"):
            (root / name).unlink()
        capsys.readouterr()
        assert main(["--undo", str(root)]) == 2
        said = capsys.readouterr().err
        assert "no journal names it; restore it from git or by hand: line " in said
        assert ": Ll1 = legs_loss.l1_loss(image, gt_image)" in said
        assert main([str(root)]) == 0
        said = capsys.readouterr()
        assert "undo it with" not in said.out
        assert "train.py is weighted, and --undo leaves it so" in said.err
        before = snapshot(root)
        assert main(["--undo", str(root)]) == 1
        said = capsys.readouterr().out
        assert "removed" not in said and "Ll1 = legs_loss.l1_loss(image, gt_image)" in said
        assert snapshot(root) == before
