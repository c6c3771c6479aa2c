"""The package as an index and a packager get it: metadata, the source distribution, types."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from email import message_from_string
from pathlib import Path

import pytest

import legs_loss
from tests.support import ROOT, legs_environment

setuptools = pytest.importorskip("setuptools", minversion="77")


def build(tree: Path, hook: str, out: Path) -> Path:
    """Run one of setuptools' build hooks in a tree, and return the file that it wrote."""
    out.mkdir(parents=True, exist_ok=True)
    program = f"from setuptools import build_meta\nprint(build_meta.{hook}({str(out)!r}))"
    done = subprocess.run([sys.executable, "-c", program], cwd=str(tree), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "SetuptoolsDeprecationWarning" not in done.stderr
    return out / done.stdout.split()[-1]


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the checkout's files, which builds may write to."""
    copy = tmp_path_factory.mktemp("tree") / "checkout"
    leave = shutil.ignore_patterns(".*", "__pycache__", "*.egg-info", "build", "dist", "site")
    shutil.copytree(str(ROOT), str(copy), ignore=leave)
    return copy


@pytest.fixture(scope="module")
def source(tree: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The source distribution, unpacked."""
    out = tmp_path_factory.mktemp("sdist")
    with tarfile.open(str(build(tree, "build_sdist", out))) as archive:
        archive.extractall(str(out))
    return out / f"legs_loss-{legs_loss.__version__}"


def metadata(tree: Path, out: Path) -> tuple:
    text = (build(tree, "prepare_metadata_for_build_wheel", out) / "METADATA").read_text(encoding="utf-8")
    message = message_from_string(text)
    return message, message.get_payload()


def test_metadata_says_what_an_index_asks_for(tree, tmp_path):
    head, _ = metadata(tree, tmp_path)
    assert head["License-Expression"] == "Apache-2.0"
    assert head.get_all("License-File") == ["LICENSE"]
    assert head["Author"] == "The legs-loss developers"
    assert head["Version"] == legs_loss.__version__
    classifiers = head.get_all("Classifier")
    for minor in range(7, 14):
        assert f"Programming Language :: Python :: 3.{minor}" in classifiers
    assert not [one for one in classifiers if one.startswith("License") or "OS Independent" in one]


def test_readme_without_an_address_has_no_link_that_breaks(tree, tmp_path):
    _, readme = metadata(tree, tmp_path)
    assert "![" not in readme
    assert not re.findall(r"\]\((?!https?:|#)", readme)
    assert "docs/method.md" in readme


def test_readme_with_an_address_shows_its_pictures(tree, tmp_path):
    copy = tmp_path / "checkout"
    shutil.copytree(str(tree), str(copy))
    with open(str(copy / "pyproject.toml"), "a", encoding="utf-8") as file:
        file.write('\n[project.urls]\nSource = "https://example.org/legs/legs-loss"\n')
    head, readme = metadata(copy, tmp_path / "out")
    tag = f"v{legs_loss.__version__}"
    pictures = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", readme)
    assert pictures
    for address in pictures:
        start = f"https://example.org/legs/legs-loss/raw/{tag}/"
        assert address.startswith(start)
        assert (ROOT / address[len(start) :]).is_file()
    assert f"(https://example.org/legs/legs-loss/blob/{tag}/docs/method.md)" in readme
    assert head["Project-URL"] == "Source, https://example.org/legs/legs-loss"


def test_the_source_distribution_holds_what_its_tests_need(source):
    for folder in ("legs_loss", "adapters", "tests", "docs", "examples", "benchmarks"):
        missing = [
            path.relative_to(ROOT).as_posix()
            for path in (ROOT / folder).rglob("*")
            if path.is_file() and not re.search(r"__pycache__|\.py[cod]$|egg-info", path.as_posix())
            if not (source / path.relative_to(ROOT)).is_file()
        ]
        assert not missing
    for name in ("CHANGELOG.md", "CITATION.cff", "LICENSE", "Makefile", "README.md", "setup.py"):
        assert (source / name).is_file()


def test_what_running_leaves_in_a_tree_is_not_packed(tree, tmp_path):
    """numba's cache is pickled machine code with the builder's paths."""
    used = tmp_path / "used"
    shutil.copytree(str(tree), str(used))
    left = [
        "kernels/__pycache__/numba_loss.all_strips-17.py311.nbi",
        "kernels/__pycache__/numba_loss.all_strips-17.py311.1.nbc",
    ]
    left += [
        "kernels/__pycache__/tmp3f9c.nbi.123",
        "__pycache__/spec.cpython-311.pyc",
        "lab/rasterizer/__pycache__/a.1.nbc",
    ]
    for name in left:
        for folder in (used / "legs_loss", used / "tests", used / "adapters" / "legs_adapters"):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(b"\x80\x04.")
    with tarfile.open(str(build(used, "build_sdist", tmp_path / "sdist"))) as archive:
        packed = archive.getnames()
    with zipfile.ZipFile(str(build(used, "build_wheel", tmp_path / "wheel"))) as wheel:
        packed += wheel.namelist()
    assert {"legs_loss/kernels/numba_loss.py", "legs_adapters/cli.py"} <= set(packed)
    assert not [name for name in packed if re.search(r"__pycache__|\.nb[ic]|\.py[cod]$|\.pytest_cache", name)]


@pytest.mark.slow
def test_the_suite_is_collected_in_the_source_distribution(source):
    environment = dict(legs_environment(), PYTHONPATH=os.pathsep.join([str(source), str(source / "adapters")]))
    command = [sys.executable, "-m", "pytest", "-q", "--collect-only", "-p", "no:cacheprovider"]
    done = subprocess.run(command, cwd=str(source), env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-3000:]
    assert re.search(r"^\d{3,} tests collected", done.stdout, re.MULTILINE)
    command = [sys.executable, "-m", "pytest", "-q", "tests/loss/test_curves.py", "tests/loss/test_spec.py"]
    done = subprocess.run(command, cwd=str(source), env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-3000:]


def test_the_changelog_has_this_version():
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.search(rf"^## {re.escape(legs_loss.__version__)}\b", text, re.MULTILINE)


@pytest.mark.slow
@pytest.mark.parametrize("package", ["legs_loss", "legs_adapters"])
def test_every_type_of_the_public_face_is_known(package, tmp_path):
    pytest.importorskip("pyright")
    # pyright reads packages as they are installed, and an editable install is none: so a venv with links.
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(tmp_path / "venv")], check=True)
    site = next((tmp_path / "venv").glob("lib/python*/site-packages"))
    (site / "legs_loss").symlink_to(ROOT / "legs_loss")
    (site / "legs_adapters").symlink_to(ROOT / "adapters" / "legs_adapters")
    (site / "others.pth").write_text("".join(f"{path}\n" for path in sys.path if path.endswith("site-packages")))
    environment = dict(os.environ, PATH=f"{tmp_path / 'venv' / 'bin'}{os.pathsep}{os.environ['PATH']}")
    command = [sys.executable, "-m", "pyright", "--verifytypes", package, "--ignoreexternal", "--outputjson"]
    done = subprocess.run(command, cwd=str(tmp_path), env=environment, capture_output=True, text=True)
    if not done.stdout.startswith("{"):
        pytest.skip(f"pyright did not run: {done.stderr[-300:]}")
    found = json.loads(done.stdout)["typeCompleteness"]
    public = [one for one in found["symbols"] if one["isExported"]]
    assert len(public) > 500
    unknown = [one["name"] for one in public if not one["isTypeKnown"] or one["isTypeAmbiguous"]]
    assert unknown == []
