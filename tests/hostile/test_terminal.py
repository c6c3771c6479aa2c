"""Names that a terminal would obey, or cannot show, are printed as escapes; nothing ends for them."""

from __future__ import annotations

import pickle
import re
import subprocess
import sys

import pytest

from legs_loss import LegsError
from legs_loss.cli import say_error
from legs_loss.store import WeightStore
from tests.patcher.support import checkout, files
from tests.preloaded import run
from tests.support import colmap_scene, legs_command, legs_environment, photograph, save


def legs_patch(*arguments, encoding):
    command = [sys.executable, "-m", "legs_adapters.cli", *map(str, arguments)]
    return run(command, env=dict(legs_environment(), PYTHONIOENCODING=encoding), text=False)


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "utf-8"])
def test_every_mode_prints_and_ends_well(encoding, tmp_path):
    name = "träin\x1b[2J\x1b]0;owned\x07→.py"
    source = files("inria")
    root = checkout(tmp_path, {**source, name: source["train.py"], "broken\x1b[31m.py": "def ("})
    for arguments, code in ((["--diff"], 0), (["--check"], 1), ([], 0), (["--undo", "--diff"], 0), (["--undo"], 0)):
        done = legs_patch(*arguments, root, encoding=encoding)
        assert done.returncode == code, done.stderr
        assert b"\x1b" not in done.stdout + done.stderr
        assert b"\x07" not in done.stdout + done.stderr
        assert b"Traceback" not in done.stderr
        assert b"\\x1b[2J" in done.stdout
    missing = legs_patch("nowhere\x1b[2J", encoding=encoding)
    assert (missing.returncode, missing.stderr.count(b"\x1b")) == (2, 0)


SLOWLY = """
import sys, time
from legs_adapters.code import checkout
from legs_adapters.cli import main
real = checkout.parse
checkout.parse = lambda *given: time.sleep(0.25) or real(*given)
sys.exit(main(["--check", sys.argv[1]]))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="a pseudo terminal")
def test_a_long_reading_says_on_a_terminal_how_far_it_is(tmp_path):
    """After two seconds, on stderr; nothing where stderr is no terminal, and nothing of a short one."""
    import fcntl
    import os
    import pty
    import struct
    import termios

    train = files("inria")["train.py"]
    root = checkout(tmp_path, {**files("inria"), **{f"other{i}/train.py": train for i in range(14)}})
    command = [sys.executable, "-c", SLOWLY, str(root)]
    quiet = run(command, env=legs_environment(), text=False)
    assert quiet.returncode == 1 and b"files read" not in quiet.stdout + quiet.stderr

    outer, inner = pty.openpty()
    fcntl.ioctl(inner, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=inner, env=legs_environment()) as child:
        os.close(inner)
        seen = b""
        with os.fdopen(outer, "rb", buffering=0) as stream:
            try:
                while True:
                    seen += stream.read(1024)
            except OSError:  # the other end is closed
                pass
        assert b"files read" not in child.stdout.read()
    counts = [tuple(map(int, found)) for found in re.findall(rb"(\d+) of (\d+) files read, \d", seen)]
    assert counts == sorted(counts) and len(counts) > 1 and counts[0][0] > 3
    assert {total for _, total in counts} == {16} and counts[-1][0] <= 16


class TestLegs:
    """Every command of ``legs`` that reads a scene, a store or a run prints the names in it."""

    EVIL = "tr\u00e4in\x1b[2J\x1b]0;owned\x07\u2192"

    def legs(self, *arguments, code, encoding="ascii"):
        environment = dict(legs_environment(), PYTHONIOENCODING=encoding)
        done = run(legs_command(*arguments), env=environment, text=False)
        assert done.returncode == code, done.stderr
        printed = done.stdout + done.stderr
        assert b"\x1b" not in printed and b"\x07" not in printed and b"Traceback" not in printed
        assert b"\\x1b[2J" in printed
        return done

    @pytest.fixture
    def scene(self, tmp_path):
        root = tmp_path / self.EVIL
        save(root / "images" / f"{self.EVIL}.png", photograph(24, 16))
        (root / "images" / f"broken{self.EVIL}.png").write_bytes(b"\x89PNG\r\n\x1a\n")
        return root

    @pytest.mark.parametrize("encoding", ["ascii", "latin-1:strict", "utf-8"])
    def test_what_is_skipped_and_what_was_written(self, scene, encoding):
        done = self.legs("precompute", scene, "--workers", 1, code=1, encoding=encoding)
        assert b"legs: skipped" in done.stderr and b"1 made, 0 up to date, 1 skipped" in done.stdout
        assert len(WeightStore(scene / "legs_weights").entries) == 1

    def test_damage_and_errors(self, scene, tmp_path):
        self.legs("precompute", scene, "--workers", 1, code=1)
        for path in (scene / "legs_weights").glob("*.npy"):
            path.write_bytes(b"")
        assert b"damaged    1" in self.legs("info", scene, code=1).stdout
        self.legs("info", tmp_path / "nowhere\x1b[2J", code=2)
        self.legs("show", scene, "--views", "nowhere\x1b[2J", code=2)
        self.legs("scene\x1b[2J", code=2)
        pytest.importorskip("matplotlib")
        self.legs("report", scene, code=2)
        self.legs("view", tmp_path / "nowhere\x1b[2J", code=2)
        self.legs("compare", scene, "--out", tmp_path / "rows", code=2)

    @pytest.fixture
    def lines(self, tmp_path):
        """A scene whose photographs have names that would be lines of a report, or colours."""
        root = tmp_path / "scene"
        for name in self.LINES:
            save(root / "images" / name, photograph(24, 16))
        (root / "images" / "br\nok\x1b[31m.png").write_bytes(b"\x89PNG\r\n\x1a\n")
        return root

    LINES = ("a\nlegs: error: b.png", "\x1b[31mred.png")

    @pytest.mark.slow
    def test_a_line_end_in_a_name_ends_no_line(self, lines, tmp_path):
        colmap = colmap_scene(tmp_path / "colmap", self.LINES)
        (colmap / "images" / self.LINES[0]).write_bytes(b"\x89PNG\r\n\x1a\n")
        store = lines / "legs_weights"
        done = self.run("precompute", lines, code=1)
        assert b"legs: skipped images/br\\nok\\x1b[31m.png: " in done.stderr
        for path in store.glob("*.npy"):
            path.write_bytes(b"")
        said = self.run("info", lines, code=1).stdout
        assert b"    images/a\\nlegs: error: b.png 24x16 laplacian" in said and b"images/\\x1b[31mred.png" in said
        for arguments in (
            ["show", lines],
            ["show", lines, "--views", "nothing"],
            ["train", colmap, "--out", tmp_path / "run"],
            ["compare", colmap, "--out", tmp_path / "rows"],
            ["info", tmp_path / "no\nlegs: error: b"],
            ["report", tmp_path / "no\nlegs: error: b"],
            ["view", tmp_path / "no\nlegs: error: b"],
        ):
            assert b"\\n" in self.run(*arguments, code=2).stderr, arguments

    def run(self, *arguments, code):
        done = run(legs_command(*arguments), env=legs_environment(), text=False)
        assert done.returncode == code, done.stderr
        printed = done.stdout + done.stderr
        assert b"\x1b[31m" not in printed and b"Traceback" not in printed
        assert b"\nlegs: error: b" not in printed
        return done

    def test_what_an_error_quotes_has_lines(self, capsys):
        say_error("legs", LegsError("the script\nof x\x1b[2J failed", "its\nlast\x1b[2J lines"))
        assert capsys.readouterr().err == "legs: error: the script\\nof x\\x1b[2J failed\nits\nlast\\x1b[2J lines\n"
        assert pickle.loads(pickle.dumps(LegsError("a", "b"))).args == ("a", "b")

    def test_a_picture_that_is_written_is_named(self, scene, tmp_path):
        pytest.importorskip("matplotlib")
        picture = tmp_path / f"{self.EVIL}.png"
        self.legs("show", scene / "images" / f"{self.EVIL}.png", "--out", picture, code=0)
        assert picture.stat().st_size > 0
