"""A checkout from a stranger that brings its own journal: it is reported, and nothing of it is done."""

from __future__ import annotations

import base64
import io
import json
import os
import random
import shutil
import signal
import subprocess
import zlib
from contextlib import redirect_stderr, redirect_stdout

import pytest
from legs_adapters.cli import main
from legs_adapters.journal import JOURNAL

from tests.patcher.support import checkout, files, legs_patch, snapshot
from tests.support import legs_environment

COMMAND = 'touch "$LEGS_ATTACK"; false'
EVIL = f"[core]\n\trepositoryformatversion = 0\n\tbare = false\n\tfsmonitor = {json.dumps(COMMAND)}\n".encode()


def pack(data):
    return base64.b64encode(zlib.compress(data)).decode()


def journal(written, created=()):
    """Return a journal that would put the second bytes where the first are, and delete files with the bytes created."""
    return json.dumps(
        {
            "version": 2,
            "note": "",
            "files": {
                name: [{"edits": [[0, len(put), now.decode()]], "original": pack(put)}]
                for name, (now, put) in dict(written).items()
            },
            "created": {name: [now.decode()] for name, now in dict(created).items()},
        }
    )


def state(folder):
    """Return every file's bytes, those in .git too but its index, which git itself rewrites."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != "index"
    }


@pytest.fixture
def attack(tmp_path):
    """A folder to put a checkout in, and the file that its commands make where they run."""
    ran = tmp_path / "attack-ran"
    yield tmp_path, ran
    assert not ran.exists(), "a command of the checkout ran"


def run(*arguments, ran, **environment):
    """Run ``legs-patch`` in this process; the effects of commands that it starts are seen all the same."""
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(err):
        for name, value in {"LEGS_ATTACK": str(ran), **environment}.items():
            patch.setenv(name, value)
        try:
            code = main([str(word) for word in arguments])
        except SystemExit as error:
            code = error.code
    return subprocess.CompletedProcess(arguments, code, out.getvalue(), err.getvalue())


NAMES = {
    "plain": ".git/config",
    "behind a dot": "./.git/config",
    "two slashes": ".//.git/config",
    "in and out": "sub/../.git/config",
    "of a nested checkout": "sub/.git/config",
    "behind a link": "g/config",
    "in capitals": ".GIT/config",
    "with a dot behind": ".git./config",
    "with a space behind": ".git /config",
    "by its short name": "GIT~1/config",
    "as a stream": ".git::$INDEX_ALLOCATION/config",
    "with a letter nobody sees": ".g\u200cit/config",
    "with backslashes": ".git\\config",
    "an absolute path": "ABSOLUTE/.git/config",
    "a link to a file": "config",
    "a hook": ".git/hooks/fsmonitor.py",
    "a shell script": "run.sh",
    "a nul": "a\0.py",
    "nothing": "",
    "the folder itself": ".",
    "outside": "../outside.py",
    "the journal": JOURNAL,
}


@pytest.mark.parametrize("what", NAMES, ids=lambda what: what.replace(" ", "_"))
def test_a_clone_with_a_journal_of_its_own(what, attack):
    """``legs-patch .; legs-patch --undo .; git status`` runs no command of the stranger's, as it once did."""
    folder, ran = attack
    root = checkout(folder / "clone", {**files("inria"), "run.sh": "old\n", "sub/.git/config": "[core]\n"}, git=True)
    for link, target in (("g", ".git"), ("config", ".git/config")):
        (root / link).symlink_to(target)
    name = NAMES[what].replace("ABSOLUTE", str(root))
    config = (root / "sub" if name.startswith("sub/.") else root) / ".git" / "config"
    (root / ".git" / "hooks" / "fsmonitor.py").write_bytes(config.read_bytes())
    current = {"run.sh": b"old\n"}.get(name, config.read_bytes())
    content = json.loads(journal({name: (current, EVIL)}, {".git/HEAD": (root / ".git" / "HEAD").read_bytes()}))
    alone = json.loads(journal({name: (current, EVIL)}))
    for each in (content, alone):
        (root / JOURNAL).write_text(json.dumps(each))
        before = state(root)
        for arguments in (["--force"], ["--undo"], ["--undo", "--force"], ["--undo", "--diff"]):
            done = run(*arguments, root, ran=ran)
            assert done.returncode == 2, arguments
            assert JOURNAL in done.stderr
            assert done.stderr.count("\n") == 1
            assert state(root) == before
    environment = dict(os.environ, LEGS_ATTACK=str(ran))
    subprocess.run(["git", "-C", str(root), "status"], stdout=subprocess.DEVNULL, env=environment, check=False)


def test_the_attack_whole(attack):
    folder, ran = attack
    origin = checkout(folder / "origin", files("inria"), git=True)
    config = b"[core]\n\trepositoryformatversion = 0\n\tfilemode = true\n\tbare = false\n"
    for name in ("./.git/config", "g/config"):
        (origin / JOURNAL).write_text(journal({name: (config, EVIL)}, {"./.git/HEAD": b"ref: refs/heads/master\n"}))
        subprocess.run(["git", "clone", "-q", str(origin), str(folder / "clone")], check=True)
        (folder / "clone" / ".git" / "config").write_bytes(config)
        (folder / "clone" / "g").symlink_to(".git")
        shutil.copy(str(origin / JOURNAL), str(folder / "clone"))
        environment = dict(legs_environment(), LEGS_ATTACK=str(ran))
        legs_patch("clone", cwd=str(folder), env=environment)
        legs_patch("--undo", "clone", cwd=str(folder), env=environment)
        subprocess.run(["git", "-C", str(folder / "clone"), "status"], env=environment, stdout=subprocess.DEVNULL)
        assert (folder / "clone" / ".git" / "config").read_bytes() == config
        shutil.rmtree(str(folder / "clone"))


@pytest.mark.parametrize("how", ["moved", "copied"])
def test_a_moved_checkout_is_undone(how, attack):
    folder, ran = attack
    root = checkout(folder / "here", files("inria"))
    before = snapshot(root)
    assert run(root, ran=ran).returncode == 0
    there = folder / "elsewhere" / "renamed"
    shutil.copytree(str(root), str(there)) if how == "copied" else shutil.move(str(root), str(there))
    assert run("--undo", there, ran=ran, HOME=str(folder / "another-home")).returncode == 0
    assert snapshot(there) == before


def layers(*contents):
    """Return a journal of one file with these layers, each a change of a good one."""
    good = {"original": pack(b"x"), "edits": []}
    return json.dumps({"version": 2, "files": {"a.py": [{**good, **change} for change in contents]}, "created": {}})


# The large ones are made by their tests alone.
DAMAGED = {
    "empty": "",
    "no json": "hello",
    "not utf-8": b"\xff\xfe",
    "deep": "[" * 100_000,
    "a number": "3",
    "a list": "[]",
    "no version": "{}",
    "another version": '{"version": 7}',
    "no files": '{"version": 2}',
    "files are a list": '{"version": 2, "files": [], "created": {}}',
    "layers are a number": '{"version": 2, "files": {"a.py": 3}, "created": {}}',
    "a layer is a number": '{"version": 2, "files": {"a.py": [3]}, "created": {}}',
    "no base64": layers({"original": "%"}),
    "not compressed": layers({"original": "AAAA"}),
    "truncated": layers({"original": pack(b"hello" * 100)[:12]}),
    "gigabytes": lambda: layers({"original": pack(bytes(200 << 20))}),
    "gigabytes in pieces": lambda: layers(*[{"original": pack(bytes(30 << 20))}] * 9),
    "edits outside": layers({"edits": [[0, 9, ""]]}),
    "edits of halves": layers({"edits": [[0, 1, "\ud800"]]}),
    "edits of floats": layers({"edits": [[0.0, 1, ""]]}),
    "edits of numbers": layers({"edits": [[0, 1, 7]]}),
    "edits over one another": layers({"edits": [[0, 1, ""], [0, 1, ""]]}),
    "60,000 patches of a file": lambda: layers(*[{}] * 60_000),
    "created by a number": '{"version": 2, "files": {}, "created": {"legs.toml": 3}}',
    "created with halves": '{"version": 2, "files": {}, "created": {"legs.toml": ["\\ud800"]}}',
    "another file created": '{"version": 2, "files": {}, "created": {"a/legs.toml": []}}',
    "a million edits": lambda: layers(
        {"original": pack(b"x" * (1 << 20)), "edits": [[i, i, "y"] for i in range(1 << 19)]}
    ),
    "100 MB": lambda: " " * (100 << 20),
    "huge numbers": '{"version": ' + "9" * 5000 + "}",
}


@pytest.mark.parametrize("what", DAMAGED, ids=lambda what: what.replace(" ", "_"))
def test_a_damaged_journal_is_one_line(what, attack):
    folder, ran = attack
    content = DAMAGED[what]
    root = checkout(folder / "mine", {**files("inria"), JOURNAL: content() if callable(content) else content})
    before = state(root)
    for arguments in (["--undo"], ["--undo", "--diff"], ["--force"]):
        done = run(*arguments, root, ran=ran)
        assert done.returncode == 2
        assert done.stderr.startswith("legs-patch: error: ")
        assert done.stderr.count("\n") == 1
        assert str(root / JOURNAL) in done.stderr
    assert state(root) == before


@pytest.mark.parametrize("what", ["link", "pipe", "folder"])
def test_a_journal_that_is_no_file(what, attack):
    folder, ran = attack
    root = checkout(folder / "mine", files("inria"))
    if what == "link":
        (folder / "elsewhere.json").write_text(journal({"train.py": ((root / "train.py").read_bytes(), b"evil")}))
        (root / JOURNAL).symlink_to(folder / "elsewhere.json")
    elif what == "pipe":
        os.mkfifo(str(root / JOURNAL))
    else:
        (root / JOURNAL).mkdir()
    before = state(root)
    for arguments in (["--undo"], []):
        done = run(*arguments, root, ran=ran)
        assert done.returncode == 2
        assert JOURNAL in done.stderr
        assert done.stderr.count("\n") == 1
    assert state(root) == before


def shuffled(count, kinds):
    """Return so many lines in no order, of so many kinds."""
    order = random.Random(count)
    return b"".join(b"%d\n" % (order.randrange(kinds) if kinds else number) for number in range(count))


LABORIOUS = {
    "50,000 edits": lambda: (b"x" * 50_000, [[i, i, "y"] for i in range(50_000)], b"z\n"),
    "lines of ninety kinds": lambda: (
        shuffled(200_000, 90),
        [[0, 0, shuffled(200_001, 90).decode()]],
        shuffled(200_002, 90),
    ),
    "lines of one kind": lambda: (
        b"\n" * 500_000 + b"a\n" + b"\n" * 500_000,
        [[9, 9, "b"]],
        b"c\n" + b"\n" * 900_000 + b"d\n",
    ),
    "lines in another order": lambda: (shuffled(200_000, 1 << 30), [[0, 9, ""]], shuffled(200_000, 0)),
}


@pytest.mark.skipif(not hasattr(signal, "alarm"), reason="needs a clock that ends it")
@pytest.mark.parametrize(
    "what", [pytest.param(what, marks=[pytest.mark.slow] * (what == "50,000 edits")) for what in LABORIOUS]
)
def test_a_journal_that_would_take_days(what, attack):
    """The refusal advises to look at the effects of a stranger's journal: that ends, whatever is in it."""
    folder, ran = attack
    original, edits, current = LABORIOUS[what]()
    content = layers({"original": pack(original), "edits": edits}).replace('"a.py"', '"train.py"')
    root = checkout(folder / "theirs", {"train.py": current, JOURNAL: content})
    before = state(root)
    signal.alarm(300)
    try:
        done = run("--undo", "--diff", "--force", root, ran=ran)
        assert done.returncode == 1, done.stderr
        assert "kept train.py: it was edited since" in done.stderr
        assert state(root) == before
        assert run("--undo", "--force", root, ran=ran).returncode == 1
        assert (root / "train.py").read_bytes() == current
    finally:
        signal.alarm(0)
