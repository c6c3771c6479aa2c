"""examples/reproduce_paper/compare.py: a codebase's own script, real subprocesses, on a miniature; profiles."""

from __future__ import annotations

import ast
import doctest
import json
import os
import re
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest

from examples.reproduce_paper.codebases import comparison, profile, training
from examples.reproduce_paper.codebases.comparison import UpstreamComparison
from examples.reproduce_paper.codebases.profile import PROFILES, Edit, Threshold, fill, find_profile, read_profile
from examples.reproduce_paper.codebases.training import (
    Checkout,
    check_copy,
    copy_checkout,
    gaussians_in,
    train_and_score,
)
from examples.reproduce_paper.compare import main
from legs_loss import LegsError
from legs_loss.cli import main as legs
from legs_loss.lab.experiments.arms import parse_arms
from legs_loss.lab.training import checkpoint
from legs_loss.spec import WeightSpec
from tests.lab.experiments.miniature import write_miniature
from tests.patcher.support import files

pytest.importorskip("numba")

# Profiles


@pytest.mark.parametrize("module", [comparison, profile], ids=lambda module: module.__name__.rpartition(".")[2])
def test_the_examples_in_docstrings(module: ModuleType) -> None:
    done = doctest.testmod(module)
    assert done.attempted and not done.failed


@pytest.mark.parametrize("path", sorted(PROFILES.glob("*.toml")), ids=lambda path: path.stem)
def test_built_in_profiles_are_whole(path: Path) -> None:
    profile = read_profile(path)
    assert profile.name == path.stem
    assert bool(profile.threshold) != bool(profile.number)  # densifies by a threshold, or to a fixed number
    checkout = Checkout(Path("copy"), profile, Path("my scene"), iterations=1000, extra=["--more"])
    command = checkout.commands(Path("out/legs/seed-0/output"), 0.5)[-1]
    told = [*command, *(edit.new for edit in profile.edits(Path("my scene")))]
    assert any("my scene" in word for word in told) and "--more" in command
    assert any("1000" in word for word in command)
    for threshold in profile.threshold:
        assert f"{0.5 * threshold.value:.6g}" in " ".join(command)


def test_what_a_framework_reads_as_python_is_quoted() -> None:
    checkout = Checkout(Path("copy"), read_profile(PROFILES / "fastergs.toml"), Path("my scene"), iterations=1000)
    values = dict(word.split("=", 1) for word in checkout.commands(Path("3dgs/seed-0/output"), 1.0)[-1] if "=" in word)
    assert ast.literal_eval(values["TRAINING.MODEL_NAME"]) == "3dgs-seed-0"
    assert {type(ast.literal_eval(value)) for value in values.values()} == {str, int, bool}


def test_fastergs_trains_and_draws_at_one_size(tmp_path: Path) -> None:
    profile = read_profile(PROFILES / "fastergs.toml")  # its inference reads the size from the file alone
    root, name = tmp_path / "root", "src/Methods/FasterGS/fastergs_garden.yaml"
    (root / name).parent.mkdir(parents=True)
    (root / name).write_text("PATH: dataset/mipnerf360/garden\nIMAGE_SCALE_FACTOR: 0.25\n")
    for resolution, factor in ((None, "null"), (1, "null"), (2, "0.5"), (8, "0.125")):
        copy = tmp_path / f"copy_{resolution}"
        Checkout(copy, profile, Path("scene"), resolution=resolution).check()
        copy_checkout(root, copy, profile.edits(Path("/my scene"), resolution))
        assert (copy / name).read_text() == f"PATH: '/my scene'\nIMAGE_SCALE_FACTOR: {factor}\n"
    with pytest.raises(LegsError, match="give -r 1, 2, 4 or 8"):
        Checkout(tmp_path, profile, Path("scene"), resolution=200).check()


def test_a_profile_is_found_by_what_a_checkout_has(tmp_path: Path) -> None:
    for name in ("train.py", "render.py", "arguments/__init__.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("")
    with pytest.raises(LegsError, match="none fit"):
        find_profile(tmp_path)
    (tmp_path / "arguments/__init__.py").write_text("self.densify_grad_threshold = 0.0002")
    assert find_profile(tmp_path).name == "3dgs"
    (tmp_path / "arguments/__init__.py").write_text("self.densify_grad_threshold, self.grad_abs_thresh = 1, 2")
    assert find_profile(tmp_path).name == "fastgs"
    assert find_profile(tmp_path, "3dgs").name == "3dgs"
    with pytest.raises(LegsError, match="3gds is no file, nor a built-in profile"):
        find_profile(tmp_path, "3gds")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("name = 3", "name has an invalid value"),
        ('extends = "4dgs"', "no built-in profile '4dgs'"),
        ('extends = "3dgs"\nrender_all = "x"', "unknown setting 'render_all'"),
        ('name = "a"', "missing"),
        ('extends = "3dgs"\ntrain = "train.py"', "train has an invalid value"),
        ('extends = "3dgs"\nrenders = { train = "a" }', "renders must have train and test"),
        ('extends = "3dgs"\nthreshold = [{ words = "--x", value = 1.0 }]', "a threshold has words with"),
        ('extends = "3dgs"\nthreshold = [{ words = "{value}" }]', "in threshold each table has words, value"),
        ('extends = "3dgs"\nedit = [{ file = "a", old = "b", new = 3 }]', "in edit each table has file, old, new"),
        ('extends = "3dgs"\nedit = ["a"]', "edit has an invalid value"),
        ('extends = "3dgs"\ntrain = []', "train must have a command"),
        ('extends = "3dgs"\nrender = []', "render must have a command"),
        ("name = ", "cannot be read"),
        ("name = " + "[" * 100_000, "cannot be read"),
        ("name = " + "9" * 5_000, "cannot be read|name is not what it should be"),
    ],
)
def test_a_wrong_profile_is_explained(tmp_path: Path, text: str, says: str) -> None:
    (tmp_path / "own.toml").write_text(text)
    with pytest.raises(LegsError, match=says):
        find_profile(tmp_path, str(tmp_path / "own.toml"))


def test_thresholds_that_the_user_gives_are_those_that_are_scaled() -> None:
    checkout = Checkout(
        Path("copy"), read_profile(PROFILES / "fastgs.toml"), Path("a"), extra=["--grad_abs_thresh", "0.0008"]
    )
    assert checkout.thresholds() == [0.0002, 0.0008]
    words = checkout.commands(Path("out/3dgs/seed-0/output"), 0.5)[-1]
    last = {flag: words[len(words) - words[::-1].index(flag)] for flag in ("--grad_thresh", "--grad_abs_thresh")}
    assert last == {"--grad_thresh": "0.0001", "--grad_abs_thresh": "0.0004"}


def test_words_that_no_one_fills_in() -> None:
    with pytest.raises(LegsError, match=r"{scenes} is unknown"):
        fill("train.py -s {scenes}", {"scene": "a"})


@pytest.mark.parametrize(
    "words", ["train.py {}", "train.py {scene", "train.py '", "{scene.x}", "{scene[0]}", "{scene:d}"]
)
def test_words_that_cannot_be_filled_in(words: str) -> None:
    with pytest.raises(LegsError, match=re.escape(repr(words))):
        fill(words, {"scene": Path("a")})


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"train": ("train.py -s {scene} -m {ouput}",)}, r"{ouput} is unknown"),
        ({"render": ("render.py -m {scene}",)}, r"{scene} is unknown"),
        ({"shorter": "--iterations {iteration}"}, r"{iteration} is unknown"),
        ({"threshold": (Threshold("--grad {value} {more}", 0.1),)}, r"{more} is unknown"),
        ({"results": "runs/{nme}_*"}, r"{nme} is unknown"),
        ({"cloud": "/elsewhere/*.ply"}, "'/elsewhere/\\*.ply' is no pattern of files"),
        ({"renders": {"train": ".", "test": "test"}}, "'.' is no pattern of files"),
        ({"resolution": ""}, "has no option for resolution"),
    ],
)
def test_a_profile_is_checked_before_anything_is_trained(change, says) -> None:
    profile = replace(read_profile(PROFILES / "3dgs.toml"), **change)
    with pytest.raises(LegsError, match=says):
        Checkout(Path("copy"), profile, Path("scene"), resolution=48, iterations=40).check()


@pytest.mark.parametrize("word", ["-r", "--resolution", "--resolution=4", "--iterations", "-i", "--cap_max"])
def test_what_the_command_says_itself_is_not_an_extra(word: str) -> None:
    checkout = Checkout(Path("copy"), read_profile(PROFILES / "3dgs-mcmc.toml"), Path("scene"), extra=[word, "4"])
    with pytest.raises(LegsError, match=f"--extra has {word}: give --(resolution|iterations|images|gaussians)"):
        checkout.check()


def test_the_newest_of_several_is_found_by_number(tmp_path: Path) -> None:
    profile = replace(read_profile(PROFILES / "3dgs.toml"), results="runs/{name}_*")
    for step in ("7000", "30000", "9000"):
        (tmp_path / "runs" / f"3dgs-seed-0_{step}").mkdir(parents=True)
    found = Checkout(tmp_path, profile, Path("scene")).results(tmp_path / "3dgs" / "seed-0" / "output")
    assert found.name == "3dgs-seed-0_30000"


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes in this file system")
def test_a_checkout_is_copied_without_what_is_no_file(tmp_path: Path) -> None:
    root = tmp_path / "root"
    (root / "folder.py").mkdir(parents=True)
    (root / "train.py").write_text("import torch\n")
    (root / "lost").symlink_to("nowhere")
    for name in ("pipe", "pipe.py"):
        os.mkfifo(str(root / name))
    copy_checkout(root, tmp_path / "copy")
    assert sorted(os.listdir(str(tmp_path / "copy"))) == [".git", "folder.py", "lost", "train.py"]


def test_a_copy_has_the_edits_of_its_profile(tmp_path: Path) -> None:
    root = tmp_path / "root"
    root.mkdir()
    (root / "garden.yaml").write_text("PATH: dataset/garden\nSTEP: 8\n")
    edit = Edit("garden.yaml", "PATH: dataset/garden", "PATH: '{scene}'")
    profile = replace(read_profile(PROFILES / "3dgs.toml"), edit=(edit,))
    copy_checkout(root, tmp_path / "copy", profile.edits(Path("/my scene")))
    assert (tmp_path / "copy/garden.yaml").read_text() == "PATH: '/my scene'\nSTEP: 8\n"
    assert (root / "garden.yaml").read_text() == "PATH: dataset/garden\nSTEP: 8\n"
    for edit in (Edit("garden.yaml", "PATH: elsewhere", ""), Edit("other.yaml", "PATH", "")):
        with pytest.raises(LegsError, match=f"{edit.file}: the profile edits '{edit.old}', which is not there"):
            copy_checkout(root, tmp_path / "new", [edit])
        assert not list(tmp_path.glob("new*"))


def test_an_edit_never_follows_a_link_out_of_the_copy(tmp_path: Path) -> None:
    own = tmp_path / "method"
    own.mkdir()
    (own / "garden.yaml").write_text("PATH: dataset/garden\n")
    root = tmp_path / "root"
    root.mkdir()
    (root / "Method").symlink_to(own)
    with pytest.raises(LegsError, match="a link leads the edit of the profile out of the copy"):
        copy_checkout(root, tmp_path / "copy", [Edit("Method/garden.yaml", "dataset/garden", "elsewhere")])
    assert (own / "garden.yaml").read_text() == "PATH: dataset/garden\n"
    assert not list(tmp_path.glob("copy*"))


def test_environments_and_the_comparison_itself_are_not_copied(tmp_path: Path) -> None:
    (tmp_path / "packages").mkdir()
    (tmp_path / "packages" / "pyvenv.cfg").write_text("")
    (tmp_path / "packages" / "a.py").write_text("import legs_loss\n")
    (tmp_path / "train.py").write_text("import torch\n")
    (tmp_path / "out" / "3dgs").mkdir(parents=True)
    copy_checkout(tmp_path, tmp_path / "out" / "upstream")  # the default folder, given where the checkout is
    assert sorted(os.listdir(str(tmp_path / "out" / "upstream"))) == [".git", "train.py"]
    check_copy(tmp_path, tmp_path / "out" / "upstream")


def test_a_file_that_cannot_be_copied_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_, **__):
        raise shutil.Error([("data.bin", "copy/data.bin", "[Errno 13] Permission denied"), ("b", "c", "d")])

    monkeypatch.setattr(shutil, "copytree", fail)
    with pytest.raises(LegsError, match=r"^data.bin cannot be copied: \[Errno 13\] Permission denied$"):
        copy_checkout(tmp_path, tmp_path / "copy")


def test_a_comparison_goes_on_with_the_checkout_that_it_began_with(tmp_path: Path) -> None:
    root, copy = tmp_path / "root", tmp_path / "out" / "upstream"
    root.mkdir()
    for name in ("train.py", "settings.py"):
        (root / name).write_text("a = 1\n")
    edits = [Edit("settings.py", "1", "2")]
    copy_checkout(root, copy, edits)
    for same in (root, copy):
        check_copy(same, copy, edits)
    (root / "train.py").write_text("a = 3\n")
    with pytest.raises(LegsError, match=r"train.py: the comparison was started with another checkout"):
        check_copy(root, copy, edits)
    with pytest.raises(LegsError, match="there is no folder"):
        check_copy(tmp_path / "nowhere", copy, edits)


# One run


LAUNCH = training.LAUNCH
SEEDS = """
import random
import numpy, torch
from examples.reproduce_paper.launch import move_seeds
move_seeds(2)
numpy.random.seed(seed=3)
torch.random.manual_seed(5)
print(numpy.random.randint(1 << 30), torch.initial_seed())
for seed in ((), (None,), (0,), ("a",)):
    random.seed(*seed)
    print(random.random())
"""


def test_seeds_are_moved_however_they_are_set() -> None:
    import numpy as np

    said = subprocess.run([sys.executable, "-c", SEEDS], stdout=subprocess.PIPE, check=True).stdout.decode().split()
    assert int(said[0]) == np.random.RandomState(3 + 2 * 1_000_003).randint(1 << 30)
    assert int(said[1]) == 5 + 2 * 1_000_003
    assert said[2] == said[3] == said[4] != said[5]


PARENT = f"""
import subprocess, sys
words = [sys.executable, {str(LAUNCH)!r}, "report.json", "0", "--cpu", "train.py"]
subprocess.run(words)
"""


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="a process is told that its parent ended by another parent's number")
def test_a_training_ends_with_the_comparison_that_was_killed(tmp_path: Path) -> None:
    (tmp_path / "train.py").write_text(
        "import time\nwhile True:\n    open('beat', 'w').write(str(time.time()))\n    time.sleep(0.1)\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", PARENT], cwd=str(tmp_path), stderr=subprocess.DEVNULL)
    beat = tmp_path / "beat"
    until = time.monotonic() + 120
    while not beat.exists() and time.monotonic() < until:
        time.sleep(0.1)
    assert beat.exists()
    parent.kill()
    parent.wait()
    time.sleep(2.0)
    last = beat.stat().st_mtime_ns
    time.sleep(2.0)
    assert beat.stat().st_mtime_ns == last


def test_a_baseline_of_which_nothing_was_counted_is_no_baseline(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(training, "_once", lambda *_: {"weighted": 0, "plain": 0})
    checkout = Checkout(tmp_path, read_profile(PROFILES / "3dgs.toml"), Path("scene"))
    with pytest.raises(LegsError, match="no call of its loss was counted"):
        train_and_score(checkout, WeightSpec(beta=0.0), 0, tmp_path / "3dgs" / "seed-0", 1.0)


# A comparison


def test_settings_that_cannot_be_used_leave_the_folder_as_it_was(
    tiny_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    profile = write_miniature(tmp_path / "miniature", tiny_scene)
    words = [str(tiny_scene), str(tmp_path / "miniature"), "--profile", str(profile)]
    words += ["--arms", "legs", "-m", str(tmp_path / "out")]
    for change, says in (
        (["--iterations", "0"], "iterations must be at least 1"),
        (["-r", "0"], "resolution must be 1, 2, 4, 8"),
        (["--gaussians", "100"], "has no option for gaussians"),
        (["--extra=-r 12"], "--extra has -r: give --resolution"),
    ):
        assert main([*words, *change]) == 2
        assert says in capsys.readouterr().err
        assert not list((tmp_path / "out").glob("*"))


def test_a_comparison_is_not_resumed_by_another_profile(tiny_scene: Path, tmp_path: Path) -> None:
    profile = read_profile(write_miniature(tmp_path / "miniature", tiny_scene))
    for _ in range(2):
        UpstreamComparison(tmp_path / "miniature", profile, tiny_scene, tmp_path / "out")
    other = replace(profile, shorter="--iterations {iterations} --quiet")
    with pytest.raises(LegsError, match=r"started with another upstream.commands.shorter"):
        UpstreamComparison(tmp_path / "miniature", other, tiny_scene, tmp_path / "out")


def test_two_comparisons_do_not_train_the_same_row(tiny_scene: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(checkpoint, "WAIT", 0.0)
    profile = read_profile(write_miniature(tmp_path / "miniature", tiny_scene))
    comparison = UpstreamComparison(tmp_path / "miniature", profile, tiny_scene, tmp_path / "out")
    row = checkpoint.alone_in(tmp_path / "out" / "3dgs" / "seed-0", make=True)
    with row, pytest.raises(LegsError, match="seed-0: another training writes there"):
        comparison.train(parse_arms(["3dgs"]), [0], lambda line: None)
    whole = checkpoint.alone_in(tmp_path / "out", make=True)
    with whole, pytest.raises(LegsError, match="out: another training writes there"):
        UpstreamComparison(tmp_path / "miniature", profile, tiny_scene, tmp_path / "out")


@pytest.fixture(scope="module")
def compared(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory):
    """Two seeds of a comparison: its folder, and the command that made it."""
    folder = tmp_path_factory.mktemp("upstream")
    profile = write_miniature(folder / "miniature", tiny_scene)
    words = [str(tiny_scene), str(folder / "miniature"), "--profile", str(profile)]
    words += ["--arms", "legs", "legs:mean1", "3dgs@legs", "--seeds", "2", "-r", "24", "--iterations", "30"]
    words += ["-m", str(folder / "out")]
    assert main(words) == 0
    return folder, words


def rows(folder: Path):
    found = [json.loads(path.read_text()) for path in (folder / "out").glob("*/seed-*/row.json")]
    return {(row["arm"], row["seed"]): row for row in found}


@pytest.mark.slow
def test_every_arm_is_trained_by_the_codebases_own_script(compared) -> None:
    folder, _ = compared
    found = rows(folder)
    assert set(found) == {(arm, seed) for arm in ("3dgs", "legs", "legs:mean1", "3dgs@legs") for seed in (0, 1)}
    proof = json.loads((folder / "out" / "comparison.json").read_text())["baseline"]
    assert proof == {"weighted_calls": 0, "plain_calls": 30}
    for seed in (0, 1):
        metrics = {arm: row["metrics"] for (arm, of), row in found.items() if of == seed}
        assert metrics["legs"]["weighted_calls"] == metrics["legs:mean1"]["weighted_calls"] == 30
        assert metrics["3dgs@legs"]["weighted_calls"] == 0
        assert metrics["legs"]["gaussians"] > 1.2 * metrics["3dgs"]["gaussians"]
        assert metrics["3dgs@legs"]["gaussians"] == pytest.approx(metrics["legs"]["gaussians"], rel=0.01)
        assert metrics["legs:mean1"]["mean_weight"] == pytest.approx(1.0)
        assert found["3dgs@legs", seed]["upstream"]["threshold_factor"] < 1
    saved = folder / "out" / "3dgs" / "seed-0" / "output" / "point_cloud"
    counts = [gaussians_in(saved / name / "point_cloud.ply") for name in ("iteration_7", "iteration_30")]
    assert counts[0] < counts[1] == found["3dgs", 0]["metrics"]["gaussians"]
    begun = [(folder / "out" / "3dgs-at-legs" / f"seed-{seed}" / "factor-0.5").is_dir() for seed in (0, 1)]
    assert begun == [True, False]  # the second search begins where the first ended
    assert found["3dgs", 0]["metrics"]["train"] != found["3dgs", 1]["metrics"]["train"]  # the script's seed is always 0


@pytest.mark.slow
def test_without_a_gpu_the_ssim_of_every_arm_is_the_packages(tiny_scene: Path, tmp_path: Path) -> None:
    profile = write_miniature(tmp_path / "miniature", tiny_scene)
    script = tmp_path / "miniature" / "train.py"
    lines = script.read_text().splitlines()
    first = lines.index("def ssim(img1, img2):")
    script.write_text("\n".join([*lines[:first], "from loss_utils import ssim", *lines[first + 3 :], ""]))
    (script.parent / "loss_utils.py").write_text(files("ssim_beside_l1_fused")["utils/loss_utils.py"])
    words = [str(tiny_scene), str(script.parent), "--profile", str(profile), "--cpu"]
    words += ["--arms", "legs", "--seeds", "1", "-r", "24", "--iterations", "30", "-m", str(tmp_path / "out")]
    assert main(words) == 0
    for arm in ("3dgs", "legs"):
        log = (tmp_path / "out" / arm / "seed-0" / "train.log").read_text()
        assert "is computed by legs_loss.ssim in this run" in log
    weighted = [json.loads((tmp_path / "out" / arm / "seed-0" / "train.json").read_text()) for arm in ("3dgs", "legs")]
    assert [report["weighted"] for report in weighted] == [0, 30]


@pytest.mark.slow
def test_scores_are_those_of_the_pictures_it_wrote(compared) -> None:
    from skimage.io import imread
    from skimage.metrics import peak_signal_noise_ratio

    folder, _ = compared
    where = folder / "out" / "legs" / "seed-0" / "output" / "test" / "ours_30"
    expected = peak_signal_noise_ratio(imread(where / "gt/00000.png"), imread(where / "renders/00000.png"))
    scores = rows(folder)["legs", 0]["metrics"]["views"]["test"]
    assert scores["00000.png"]["psnr"] == pytest.approx(expected, abs=1e-3)


@pytest.mark.slow
def test_done_rows_stay_and_others_are_added(compared, capsys: pytest.CaptureFixture) -> None:
    folder, words = compared
    kept = {path: path.stat().st_mtime_ns for path in (folder / "out").glob("*/seed-*/row.json")}
    settings = folder / "out" / "comparison.json"
    written = settings.stat().st_mtime_ns
    scores = rows(folder)["legs", 1]["metrics"]["views"]
    for name in ("row", "train", "render"):  # as a killed training leaves it: with an output
        (folder / "out" / "legs" / "seed-1" / f"{name}.json").unlink()
    assert main(words) == 0
    assert rows(folder)["legs", 1]["metrics"]["views"] == scores
    assert settings.stat().st_mtime_ns == written
    printed = capsys.readouterr().out
    assert (
        "legs, seed 1" in printed
        and "legs, seed 0" not in printed
        and "too short to decide: 30 iterations" in printed.lower()
    )
    changed = {path.parent.parent.name for path, time in kept.items() if path.stat().st_mtime_ns != time}
    assert changed == {"legs"}
    assert main([*words, "--iterations", "31"]) == 2
    assert "started with another" in capsys.readouterr().err
    assert legs(["report", str(folder / "out")]) == 0
    page = (folder / "out" / "report.html").read_text(encoding="utf-8")
    assert "PSNR by Gaussians" in page and "PSNR by iterations" not in page  # nothing was scored during the runs
    assert "sh_degree" not in page  # of the package's own trainer
    assert f"examples/reproduce_paper/compare.py {words[0]} CHECKOUT --arms" in page
    assert "--seeds 2 -r 24 --iterations 30 --profile" in page


@pytest.mark.slow
def test_what_cannot_be_compared_is_refused(compared, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    folder, words = compared
    new = [*words, "-m", str(tmp_path / "new")]
    for change, says in (
        (["--arms", "legs:shuffled"], "needs the package's own trainer"),
        (["--gaussians", "100"], "has no option for gaussians"),
        (["--profile", "3dgs-mcmc"], "give it with --gaussians"),
        (["--profile", "3dgs-mcmc", "--gaussians", "1"], "give more with --gaussians, not 1"),
    ):
        assert main([*new, *change]) == 2
        assert says in capsys.readouterr().err
        shutil.rmtree(tmp_path / "new", ignore_errors=True)
    patched = tmp_path / "patched"
    shutil.copytree(folder / "miniature", patched)
    (patched / "train.py").write_text("import legs_loss\n")
    assert main([new[0], str(patched), *new[2:]]) == 2
    assert "is patched already" in capsys.readouterr().err
    broken = tmp_path / "broken"
    shutil.copytree(folder / "miniature", broken)
    (broken / "train.py").write_text((broken / "train.py").read_text().replace("points = 100", "points = 1 / 0"))
    assert main([words[0], str(broken), *words[2:], "-m", str(tmp_path / "other")]) == 2
    assert "ZeroDivisionError" in capsys.readouterr().err
    assert main([words[0], str(tmp_path / "nowhere"), *words[2:]]) == 2
    assert f"there is no folder {tmp_path / 'nowhere'}: give a checkout" in capsys.readouterr().err
