"""The codebases under tests/patching, as folders, and the verdicts in their comments."""

from __future__ import annotations

import os
import re
import subprocess
import sys

from tests.preloaded import run
from tests.support import ROOT, legs_environment

CASES = ROOT / "tests" / "patching"
# The one line that changes in the script of Inria's shape, before and after.
SITE = "        Ll1 = l1_loss(image, gt_image)\n"
PATCHED = "        Ll1 = legs_loss.l1_loss(image, gt_image)\n"
NAMES = sorted(path.stem for path in CASES.glob("*.txt") if path.stem != "common")
_MARK = re.compile(r"^\s*# (weighted|plain|fused|masked|left|error): (.*)$")


def options(name):
    """Return what a case is planned with: those of --ssim and of --masks are named so."""
    return {"ssim": name.startswith("ssim"), "masks": name.startswith("masks")}


def files(name):
    """Return the files of a case by path, with those of common.txt."""
    found = {}
    for part in ("common", name):
        for section in re.split(r"^=== ", (CASES / f"{part}.txt").read_text(encoding="utf-8"), flags=re.M)[1:]:
            path, _, text = section.partition("\n")
            found[path.strip()] = text
    return found


def expected(texts, masked=False):
    """Return {(path, line): (verdict, detail)} from the comments; on request of the lines that mask, and no others."""
    marks = {}
    for path, text in texts.items():
        lines = text.splitlines()
        for number, line in enumerate(lines, 1):
            match = _MARK.match(line)
            if match and (match.group(1) == "masked") == masked:
                while masked and lines[number].lstrip().startswith("#"):
                    number += 1
                marks[path, number + 1] = match.group(1), match.group(2)
    return marks


def without_marks(text):
    """Return a file's text without the comments that say what must become of a line."""
    return "".join(line for line in text.splitlines(True) if not _MARK.match(line))


def checkout(folder, texts, git=False):
    """Write a codebase to a folder, on request as a git checkout, and return the folder."""
    for path, text in texts.items():
        target = folder / path
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(text if isinstance(text, bytes) else text.encode("utf-8"))
    if git:
        run_git(folder, "init", "-q")
        run_git(folder, "add", ".")
        run_git(folder, "commit", "-q", "-m", "start")
    return folder


def run_git(folder, *arguments):
    """Run git there, whatever this machine's own settings say."""
    environment = dict(os.environ, GIT_CONFIG_GLOBAL=os.devnull, GIT_CONFIG_SYSTEM=os.devnull)
    for who in ("AUTHOR", "COMMITTER"):
        environment[f"GIT_{who}_NAME"] = environment[f"GIT_{who}_EMAIL"] = "test"
    return subprocess.run(
        ["git", "-C", str(folder), *arguments], check=True, env=environment, stdout=subprocess.PIPE, text=True
    ).stdout


def snapshot(folder):
    """Return every file's bytes, .git excepted."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and ".git" not in path.parts and "__pycache__" not in path.parts
    }


def legs_patch(*arguments, **options):
    """Run ``legs-patch`` in a process of its own and return the completed process, with text output."""
    return run(
        [sys.executable, "-m", "legs_adapters.cli", *map(str, arguments)], **{"env": legs_environment(), **options}
    )
