"""git is asked what was committed; no program that the checkout names is run for it, and nothing hangs."""

from __future__ import annotations

import os
import subprocess

import pytest
from legs_adapters.checkout import git as asking

from tests.hostile.test_journal import attack, run
from tests.patcher.support import checkout, files, run_git

__all__ = ["attack"]


CONFIG = """
[core]
    fsmonitor = "COMMAND"
    hooksPath = .hooks
    pager = "COMMAND"
    sshCommand = "COMMAND"
    repositoryformatversion = 1
[extensions]
    partialClone = origin
[remote "origin"]
    url = ext::COMMAND
    promisor = true
[protocol "ext"]
    allow = always
[filter "plain"]
    clean = "COMMAND"
    process = "COMMAND"
    required = true
[filter "a=b"]
    clean = "COMMAND"
[diff "plain"]
    textconv = "COMMAND"
    command = "COMMAND"
[diff]
    external = "COMMAND"
"""


@pytest.mark.parametrize("attributes", ["*.py filter=plain diff=plain\n", "*.py filter=a=b\n", ""])
@pytest.mark.parametrize("where", ["of its own", "as a file", "bare", "above"])
def test_git_runs_nothing_of_the_checkout_s(where, attributes, attack):
    """An archive, unlike a clone, brings a ``.git`` of its own; and a clone may have a bare repository in a folder."""
    folder, ran = attack
    root = checkout(folder / "theirs", {**files("inria"), ".gitattributes": attributes}, git=True)
    config = CONFIG.replace("COMMAND", f"touch {ran}")
    for hook in ("post-index-change", "post-checkout", "fsmonitor-watchman"):
        checkout(root, {f".hooks/{hook}": f"#!/bin/sh\ntouch {ran}\n", f".git/hooks/{hook}": "#!/bin/sh\nfalse\n"})
        (root / ".hooks" / hook).chmod(0o755)
    run_git(root, "rm", "-q", "--cached", "utils/loss_utils.py")
    for path in root.rglob("*.py"):
        path.write_text(path.read_text() + "\n")  # what is not as the index has it is put through the filters
    (root / ".git" / "config").write_text(config)
    target = root
    if where == "as a file":
        (root / ".git").rename(folder / "gitdir")
        (root / ".git").write_text(f"gitdir: {folder / 'gitdir'}\n")
    elif where == "bare":
        for path in (root / ".git").iterdir():
            path.rename(root / path.name)
        (root / ".git").rmdir()
        (root / "config").write_text(config.replace("[core]", "[core]\n    bare = false\n    worktree = .\n"))
    elif where == "above":
        target = root / "utils"
        (root / "train.py").rename(target / "train.py")
    run(target, ran=ran)
    run("--force", target, ran=ran)
    run("--undo", target, ran=ran)
    assert not ran.exists()
    if where == "of its own" and "plain" in attributes:  # the premise, or this proves nothing
        subprocess.run(["git", "-C", str(root), "status"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        assert ran.exists()
        ran.unlink()


def test_git_of_the_checkout_s_own_is_not_run(attack):
    folder, ran = attack
    root = checkout(folder / "theirs", {**files("inria"), "git": f"#!/bin/sh\ntouch {ran}\n"})
    (root / "git").chmod(0o755)
    assert run(root, ran=ran, PATH=os.pathsep.join([str(root), os.environ["PATH"]])).returncode == 0


INCLUDE = "[include]\n\tpath = ../evil.cfg\n"


@pytest.mark.parametrize(
    "what", ["included", "of the worktree", "of a linked worktree", "in a folder of the checkout", "of a submodule"]
)
def test_settings_from_elsewhere(what, attack):
    """Wherever the checkout's settings stand, the commands that they name are not run."""
    folder, ran = attack
    root = target = checkout(folder / "theirs", {**files("inria"), ".gitattributes": "*.py filter=plain\n"}, git=True)
    settings = root / ".git" / "config"
    if what == "included":
        settings.write_text(settings.read_text() + INCLUDE)
        settings = root / "evil.cfg"
    elif what == "of the worktree":
        settings.write_text(settings.read_text() + "[extensions]\n\tworktreeConfig = true\n")
        settings = root / ".git" / "config.worktree"
    elif what == "of a linked worktree":
        target = folder / "linked"
        run_git(root, "worktree", "add", "-q", str(target), "-b", "other")
    elif what == "of a submodule":
        target = root / "render"
        subprocess.run(["git", "clone", "-q", str(root), str(target)], check=True)
        (target / ".git").rename(root / ".git" / "of-render")
        (target / ".git").write_text("gitdir: ../.git/of-render\n")
        settings = root / ".git" / "of-render" / "config"
    else:
        (root / ".git").rename(root / "hidden")
        (root / ".git").write_text("gitdir: hidden\n")
        settings = root / "hidden" / "config"
    with open(str(settings), "a") as file:
        file.write(f'[core]\n\tfsmonitor = "touch {ran}"\n[filter "plain"]\n\tclean = "touch {ran}; cat"\n')
    for path in target.rglob("*.py"):
        path.write_text(path.read_text() + "\n")
    for place in {root, target}:
        for arguments in ([], ["--force"], ["--undo"]):
            run(*arguments, place, ran=ran)
    assert not ran.exists()
    subprocess.run(["git", "-C", str(target), "status"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    assert ran.exists(), "the premise, or this proves nothing"
    ran.unlink()


LFS = """#!/usr/bin/env python3
# What Git LFS does with lfs.extension: `git-lfs clean` hands each file to the program that the settings name.
import subprocess, sys
program = subprocess.run(["git", "config", "lfs.extension.any.clean"], stdout=subprocess.PIPE).stdout.decode().strip()
if program:
    subprocess.run(program, shell=True, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
sys.stdout.buffer.write(sys.stdin.buffer.read())
"""


def test_git_lfs_runs_no_extension_of_the_checkout_s(attack):
    """The filter is the user's own, the extension that it runs is the checkout's."""
    folder, ran = attack
    lfs = checkout(folder / "bin", {"git-lfs": LFS}) / "git-lfs"
    lfs.chmod(0o755)
    home = checkout(folder / "home", {"config": f'[filter "lfs"]\n\tclean = "{lfs} clean"\n\trequired = true\n'})
    root = checkout(folder / "theirs", {**files("inria"), ".gitattributes": "*.py filter=lfs\n"}, git=True)
    with open(str(root / ".git" / "config"), "a") as file:
        file.write(f'[lfs "extension.any"]\n\tclean = "touch {ran}"\n\tpriority = 0\n')
    environment = {"GIT_CONFIG_GLOBAL": str(home / "config")}
    os.utime(str(root / "train.py"), (1, 1))
    assert run(root, ran=ran, **environment).returncode == 0
    assert run("--undo", root, ran=ran, **environment).returncode == 0
    (root / "train.py").write_text((root / "train.py").read_text() + "\n")
    refused = run(root, ran=ran, **environment)
    assert (refused.returncode, "(train.py): commit them" in refused.stderr) == (2, True)
    assert not ran.exists()
    subprocess.run(["git", "-C", str(root), "add", "."], stdout=subprocess.DEVNULL, env=dict(os.environ, **environment))
    assert ran.exists(), "the premise, or this proves nothing"
    ran.unlink()


def test_objects_that_are_missing_are_not_fetched(attack):
    """Asked for an object that a partial clone left out, git runs the transport that the checkout's settings name."""
    folder, ran = attack
    root = checkout(folder / "theirs", {f"src/{name}": text for name, text in files("inria").items()}, git=True)
    tree = run_git(root, "rev-parse", "HEAD:src").strip()
    (root / ".git" / "objects" / tree[:2] / tree[2:]).unlink()
    (root / ".git" / "config").write_text(CONFIG.replace("COMMAND", f"touch {ran}"))
    (root / "src" / "train.py").write_text((root / "src" / "train.py").read_text() + "\n")
    assert run(root, ran=ran).returncode == 0  # not known, so not refused
    assert run("--undo", root, ran=ran).returncode == 0
    assert not ran.exists()
    subprocess.run(["git", "-C", str(root), "ls-tree", "HEAD", "src/train.py"], stderr=subprocess.DEVNULL)
    assert ran.exists(), "the premise, or this proves nothing"
    ran.unlink()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes in this file system")
@pytest.mark.parametrize("name", ["config", "HEAD", "objects/info/alternates"])
def test_a_pipe_in_dot_git_is_waited_for_once(name, attack, monkeypatch):
    folder, ran = attack
    root = checkout(folder / "theirs", files("inria"), git=True)
    path = root / ".git" / name
    if path.exists():
        path.unlink()
    os.mkfifo(str(path))
    monkeypatch.setattr(asking, "_SECONDS", 1)
    before = (root / "train.py").read_bytes()
    done = run(root, ran=ran)
    assert (done.returncode, "within 1 seconds; nothing was written" in done.stderr) == (2, True), done.stderr
    assert (root / "train.py").read_bytes() == before
    assert run("--force", root, ran=ran).returncode == 0
    assert run("--undo", root, ran=ran).returncode == 0
    assert (root / "train.py").read_bytes() == before


@pytest.mark.parametrize("name", [".GIT", ".git.", "GIT~1", ".g\u200cit", ".git ::$INDEX_ALLOCATION"])
def test_what_some_file_system_takes_for_dot_git_is_not_entered(name, attack):
    folder, ran = attack
    theirs = files("inria")
    root = checkout(folder / "theirs", {**theirs, f"{name}/hooks/train.py": theirs["train.py"]})
    assert run(root, ran=ran).returncode == 0
    assert (root / name / "hooks" / "train.py").read_text() == theirs["train.py"]
    assert "legs_loss" in (root / "train.py").read_text()


@pytest.mark.parametrize("name", ["a\\b.py", "a\nskipped b.py", "a\rb.py", "a\nb/c.py"])
def test_a_name_that_is_never_written_costs_that_file_only(name, attack):
    folder, ran = attack
    theirs = files("inria")
    root = checkout(folder / "theirs", {**theirs, name: theirs["train.py"]})
    done = run(root, ran=ran)
    assert done.returncode == 0
    unread = [line for line in done.stdout.splitlines() if "legs-patch writes no file of this name: rename it" in line]
    assert len(unread) == 1 and unread[0].startswith(name.replace("\n", "\\n").replace("\r", "\\r"))
    assert (root / name).read_text() == theirs["train.py"]
    assert "legs_loss" in (root / "train.py").read_text()
    assert run("--undo", root, ran=ran).returncode == 0
