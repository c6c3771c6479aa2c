"""legs-patch --verify on a training codebase in the shape of the public ones."""

from __future__ import annotations

import json

import pytest
from legs_adapters.trace.child import Run
from legs_adapters.verify import Verdict, _claims

from tests.patcher.support import checkout, legs_patch, snapshot
from tests.patcher.traced import write, write_scene
from tests.shims.test_run import texts

pytest.importorskip("numba")
pytest.importorskip("scipy")


ANOTHER = "with LEGS every loss of a photograph is another"
WEIGHTED = "every loss of a photograph was weighted"


def verify(root, *arguments):
    return legs_patch("--verify", "--json", "--iterations", "6", root, *arguments, timeout=900)


def verdict(done):
    """Return the output after the patch's own report."""
    return json.loads(done.stdout[done.stdout.rindex('{"holds"') :])


@pytest.mark.slow
class TestVerify:
    def test_a_patch_that_took(self, tmp_path):
        found = texts()
        folder = "    safe_state()\n    __import__('os').mkdir('mine')\n"  # it fails where another run was before
        found["train.py"] = found["train.py"].replace("    safe_state()\n", folder)
        root = checkout(tmp_path / "miniature", found)
        unpatched = snapshot(root)
        done = verify(root)
        assert done.returncode == 0, done.stdout + done.stderr
        found = verdict(done)
        assert all(found["holds"].values())
        runs = found["runs"]
        assert runs["unpatched"]["losses"] == runs["LEGS_OFF"]["losses"] != runs["patched"]["losses"]
        assert len(runs["patched"]["losses"]) == 6
        patched = runs["patched"]
        assert patched["weighted"] == 6
        assert patched["stored"] == 6
        assert patched["computed"] == 0
        assert all(0 < seconds < 600 for seconds in patched["seconds"])
        # The folder is as the patch alone leaves it.
        after = snapshot(root)
        assert {name for name in after if after[name] != unpatched.get(name)} == {
            "train.py", "legs.toml", ".legs-patch.json",
        }  # fmt: skip
        again = verify(root)  # patched before
        assert again.returncode == 0, again.stdout + again.stderr
        assert legs_patch("--undo", root).returncode == 0
        assert snapshot(root) == unpatched

    def test_one_that_changes_nothing_is_found_out(self, tmp_path):
        root = checkout(tmp_path / "miniature", texts())
        done = verify(root, "--preset", "3dgs")
        assert done.returncode == 1
        failed = {claim for claim, held in verdict(done)["holds"].items() if not held}
        plain = {claim for claim in failed if claim.startswith("train.py:")}
        assert failed - plain == {ANOTHER, WEIGHTED}
        assert [" is weighted: " in claim and "is images/" in claim for claim in plain] == [True]

    def test_a_script_that_cannot_run_is_shown(self, tmp_path):
        found = texts()
        found["train.py"] = found["train.py"].replace("    safe_state()\n", "    safe_state()\n    1 / 0\n")
        done = legs_patch("--verify", checkout(tmp_path / "miniature", found), timeout=900)
        assert done.returncode == 1
        assert "FAILS      the unpatched script trained" in done.stdout
        assert done.stdout.count("ZeroDivisionError") == 1


TRAIN = """
for step in range(100):
    camera = views[step % len(views)]
    drawn, gt_image, target = splats.draw(camera), camera.values["images"], camera.values["normals"]
    loss = torch.abs(drawn["rgb"] - gt_image).mean()
    loss = loss + 0.1 * F.l1_loss(drawn["normal"], target)
    loss = loss + 0.1 * F.l1_loss(drawn["depth"], target[:1])
    loss.backward()
    splats.optimizer.step()
    splats.optimizer.zero_grad()
"""


@pytest.mark.slow
class TestTerms:
    """Each L1 of the patched run: that of a photograph is weighted, and no other."""

    def holds(self, root, scene, *options):
        options = options or ("--script", "train.py", "--arguments", f"-s {scene}")
        done = verify(root, *options)
        found = verdict(done)["holds"]
        return done, {claim.split(":")[1]: held for claim, held in found.items() if claim.startswith("train.py:")}

    def test_of_a_patch_and_of_two_that_were_altered(self, tmp_path):
        write(tmp_path / "code", TRAIN)
        scene, train = write_scene(tmp_path / "scene"), tmp_path / "code/train.py"
        done, claims = self.holds(tmp_path / "code", scene, "--trace", f"train.py -s {scene}", "--cpu", "--steps", "4")
        lines = train.read_text(encoding="utf-8").splitlines()
        colour, normal, depth = (
            next(str(at) for at, line in enumerate(lines, 1) if f'(drawn["{name}"]' in line)
            for name in ("rgb", "normal", "depth")
        )
        assert done.returncode == 0, done.stdout + done.stderr
        assert claims == {
            f"{colour} is weighted": True, f"{normal} is not weighted": True, f"{depth} is not weighted": True,
        }  # fmt: skip
        patched = train.read_text(encoding="utf-8")
        for name, line in (("normal", normal), ("depth", depth)):
            term = f'F.l1_loss(drawn["{name}"]'
            assert term in patched
            train.write_text(patched.replace(term, f"legs_loss{term[1:]}"), encoding="utf-8")
            done, claims = self.holds(tmp_path / "code", scene)
            assert done.returncode == 1
            assert [claim for claim, held in claims.items() if not held] == [f"{line} is not weighted"], claims
        term = 'legs_loss.l1_loss(drawn["rgb"]'
        assert term in patched
        train.write_text(patched.replace(term, 'legs_loss.unweighted(F.l1_loss)(drawn["rgb"]'), encoding="utf-8")
        done, claims = self.holds(tmp_path / "code", scene)
        assert done.returncode == 1
        assert [claim for claim, held in claims.items() if not held] == [f"{colour} is weighted"], claims


def terms_under(kind, passes):
    """Return what a run reports of one L1 of a photograph under these losses, and in a pass of no loss."""
    shares = [(at, 0.5) for at in (0, *passes)]
    match = {"path": "a.png", "correlation": 1.0, "is_photograph": True}
    return [{
        "frames": [], "kind": kind, "target": 1, "shape": [3, 8, 8], "is_picture": True, "match": match,
        "is_known": True, "largest": 1.0, "is_rival": False, "shares": shares, "steps": 9, "gaussians": 9,
        "parameters": [], "stepped": [], "poses": 0,
    }] * bool(passes)  # fmt: skip


OTHER_PASSES = """
for step in range(100):
    camera = views[step % len(views)]
    drawn, gt_image = splats.draw(camera), camera.values["images"]
    if step % 2:
        (0.2 * (drawn["rgb"] - gt_image).square().mean()).backward()
    else:
        F.l1_loss(drawn["rgb"], gt_image).backward()
    (0.01 * splats.opacity.square().mean()).backward()
    splats.optimizer.step()
    splats.optimizer.zero_grad()
"""


@pytest.mark.slow
def test_a_step_of_several_passes_of_which_one_is_of_a_photograph(tmp_path):
    write(tmp_path / "code", OTHER_PASSES)
    done = verify(tmp_path / "code", "--arguments", f"-s {write_scene(tmp_path / 'scene')}")
    assert done.returncode == 0, done.stdout + done.stderr
    assert verdict(done)["holds"][WEIGHTED] and verdict(done)["runs"]["patched"]["weighted"] > 1


class TestReport:
    def test_both_steps_times_are_compared(self):
        plain = Run(0, ["0x1p+0"] * 4, [0.05, 0.04, 0.01], plain=4)
        patched = plain._replace(seconds=[0.05, 0.06, 0.9])
        found = Verdict({"unpatched": plain, "patched": patched, "LEGS_OFF": plain}, {}).text()
        assert "unpatched  4 steps, 40 ms a step" in found
        assert "step       patched takes 1.50 times the unpatched one's time (medians)" in found

    @pytest.mark.parametrize(
        ("of_photographs", "weighted", "by_hand", "failing"),
        [
            ((1, 3, 5), (1, 3, 5), False, []),  # each second pass is a regulariser's
            ((1, 3, 5), (1, 3, 3), False, [WEIGHTED]),  # two terms under one loss hide none without
            ((1, 2, 3, 5), (1, 2, 3, 5), False, [ANOTHER]),
            ((), (1, 3, 5), False, [ANOTHER, WEIGHTED]),  # no picture is known: every loss counts
            ((1, 3, 5), (1, 5), True, []),  # the user chose
            ((1, 3, 5), (), True, [WEIGHTED]),
        ],
    )
    def test_each_loss_of_a_photograph_is_to_be_weighted_and_another(self, of_photographs, weighted, by_hand, failing):
        off = Run(0, ["0x1p+0"] * 6, terms=terms_under("l1", of_photographs))
        patched = Run(0, ["0x2p+0", "0x1p+0"] * 3, weighted=4, terms=terms_under("weighted", weighted))
        claims = _claims({"unpatched": off, "patched": patched, "LEGS_OFF": off}, by_hand)
        assert [claim for claim, held in claims.items() if not held] == failing

    def test_a_run_without_steps_is_not_compared(self):
        ended = Run(1, error="error")
        found = Verdict({"unpatched": ended, "patched": ended, "LEGS_OFF": ended}, {}).text()
        assert "no step, exit code 1" in found and "times the" not in found


class TestUsage:
    def test_missing_packages_are_named_before_anything_is_written(self, tmp_path):
        found = texts()
        found["train.py"] = "import cv2_is_not_here\nfrom extras import dust\n" + found["train.py"]
        found["extras.py"] = (
            "import diff_gaussian_rasterization\nimport lpips\nimport plyfile_is_not_here.parts\n"
            "try:\n    import faster_is_not_here\nexcept ImportError:\n    pass\n"
        )
        root = checkout(tmp_path / "miniature", found)
        before = snapshot(root)
        done = verify(root)
        assert done.returncode == 2
        assert done.stderr == (
            "legs-patch: error: train.py imports cv2_is_not_here, plyfile_is_not_here, not installed here: "
            "pip install cv2_is_not_here plyfile_is_not_here\n"
        )
        assert snapshot(root) == before

    def test_no_such_script(self, tmp_path):
        root = checkout(tmp_path / "miniature", texts())
        before = snapshot(root)
        done = verify(root, "--script", "nowhere.py")
        assert done.returncode == 2
        assert snapshot(root) == before
        assert "there is no nowhere.py" in done.stderr

    def test_an_unknown_place_in_the_arguments(self, tmp_path):
        root = checkout(tmp_path / "miniature", texts())
        done = verify(root, "--arguments", "-s {secen}")
        assert done.returncode == 2
        assert "only {scene}, {output}, {iterations}, {port}" in done.stderr
