"""A profile of a codebase from a stranger, run whole: its commands run, and nothing beside them."""

from __future__ import annotations

import pytest

from examples.reproduce_paper.compare import main
from tests.lab.experiments.miniature import write_miniature

pytest.importorskip("numba")

TRAIN = "train.py -s {scene} -m {output}"
EDIT = 'edit = [{{ file = "{}", old = "mine", new = "theirs" }}]'
# What the profile says, and the one line that is expected; PLACE is a folder that is not the comparison's.
PROFILES = {
    "an edit above the checkout": (EDIT.format("../precious.py"), "leads the edit of the profile out of the copy"),
    "an edit of an absolute path": (EDIT.format("PLACE/precious.py"), "leads the edit of the profile out of the copy"),
    "an edit through a folder": (EDIT.format("sub/../../precious.py"), "leads the edit of the profile out of the copy"),
    "a command after a semicolon": (f'train = ["{TRAIN} ; touch PLACE/ran"]', "ended with exit code 2"),
    "a command in a command": (f'train = ["{TRAIN} $(touch PLACE/ran)"]', "ended with exit code 2"),
    "no script": ('train = ["$(touch PLACE/ran)"]', "ended with exit code 2"),
    "a quotation without an end": (f"""train = ["{TRAIN} '"]""", "No closing quotation"),
    "renderings above the run": ('renders = { train = "../*", test = "../*" }', "is no pattern of files"),
    "a cloud above the run": ('cloud = "../../../*.ply"', "is no pattern of files"),
    "a cloud of an absolute path": ('cloud = "PLACE/*.ply"', "is no pattern of files"),
    "results above the copy": ('results = "../{name}"', "is no pattern of files"),
    "10^30 iterations": (f"iterations = {10**30}", "iterations must be"),
    "10^400 iterations": (f"iterations = {10**400}", "iterations must be"),
    "10^5000 iterations": (f"iterations = 1{'0' * 5000}", "cannot be read"),
    "an infinite threshold": ('threshold = [{ words = "--grad {value}", value = inf }]', "in threshold each table"),
    "a threshold that is no number": ('threshold = [{ words = "--grad {value}", value = nan }]', "in threshold each"),
    "a threshold of 1e999": ('threshold = [{ words = "--grad {value}", value = 1e999 }]', "in threshold each table"),
    "a list for a name": ('name = ["a"]', "name has an invalid value"),
    "no TOML": ("\0", "cannot be read"),
}


# These run a copy of the checkout as far as their command.
RUN = ("a command after a semicolon", "a command in a command", "no script")
CASES = [
    pytest.param(what, id=what.replace(" ", "_"), marks=[pytest.mark.slow] if what in RUN else []) for what in PROFILES
]


@pytest.mark.parametrize("what", CASES)
def test_a_stranger_s_profile(what, tiny_scene, tmp_path, capsys):
    text, line = PROFILES[what]
    place = tmp_path / "place"
    place.mkdir()
    for folder in (place, tmp_path):
        (folder / "precious.py").write_text("mine\n")
    profile = write_miniature(tmp_path / "miniature", tiny_scene)
    (tmp_path / "miniature" / "sub").mkdir()
    text = text.replace("PLACE", place.as_posix())
    key = text.partition(" ")[0]
    lines = profile.read_text().split("\n[[threshold]]")
    kept = [one for one in lines[0].splitlines() if one.partition(" ")[0] != key]
    table = [] if key == "threshold" else ["[[threshold]]" + lines[1]]
    profile.write_text("\n".join([text, *kept, *table]))
    words = [str(tiny_scene), str(tmp_path / "miniature"), "--profile", str(profile), "--arms", "legs", "--seeds", "1"]
    assert main([*words, "-r", "24", "-m", str(tmp_path / "out")]) == 2
    errors = capsys.readouterr().err
    assert [text for text in errors.splitlines() if "error:" in text and line in text], errors
    assert "Traceback" not in errors.partition("\n")[0]
    assert [path.name for path in place.iterdir()] == ["precious.py"]
    for folder in (place, tmp_path):
        assert (folder / "precious.py").read_text() == "mine\n"
