"""Check that installing the wheel leaves an older torch where it is.

A rasterizer is compiled against the torch that it was built with; a newer torch breaks it. For every Python found here
and every torch that upstream codebases ask for, pip resolves the wheel by dry run beside a stub distribution of that
torch, alone and with each extra that a user would ask for. The check fails if torch, or numpy beside the bare wheel,
would move.

    python .ci/torch_stays.py dist/legs_loss-*.whl
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Dict, List, Tuple

# The Pythons that each torch has wheels for.
TORCH = {
    "1.12.1": ("3.7", "3.8", "3.9", "3.10"),
    "1.13.1": ("3.7", "3.8", "3.9", "3.10", "3.11"),
    "2.1.2": ("3.8", "3.9", "3.10", "3.11"),
    "2.4.1": ("3.8", "3.9", "3.10", "3.11", "3.12"),
    "2.5.1": ("3.9", "3.10", "3.11", "3.12", "3.13"),
}
# A numpy of before 2.0, which every torch up to 2.2 needs, by the Pythons that have it.
NUMPY = {"3.7": "1.21.6", "3.8": "1.21.6", "3.9": "1.21.6", "3.10": "1.22.4", "3.11": "1.24.4", "3.12": "1.26.4"}
EXTRAS = ("", "[all]")


def main() -> int:
    """Resolve the wheel for every Python and torch; return 1 if any install would move torch."""
    wheel = Path(sys.argv[1]).resolve()
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(os.cpu_count()) as pool:
        tasks = [
            pool.submit(resolutions, wheel, version, python, Path(folder) / version)
            for version, python in pythons().items()
        ]
        results = [moved for task in tasks for moved in task.result()]
    print(f"{len(results)} resolutions, {sum(results)} that move torch or numpy")
    return 1 if any(results) or not results else 0


def resolutions(wheel: Path, version: str, python: str, folder: Path) -> List[bool]:
    """Resolve the wheel on one Python beside each torch that has wheels for it; return which resolutions move it."""
    pip = environment(folder, python)
    results = []
    for torch in (torch for torch, versions in TORCH.items() if version in versions):
        stubs = {"torch": torch, "numpy": NUMPY.get(version, "2.1.0")}
        install(pip, [stub(folder, name, number) for name, number in stubs.items()])
        for extra in EXTRAS:
            new = resolve(pip, f"{wheel}{extra}", folder / "report.json")
            changed = {name: new[name] for name in stubs if name in new and (name == "torch" or not extra)}
            words = ", ".join(f"{name} {stubs[name]} -> {number}" for name, number in changed.items())
            print(f"Python {version}, torch {torch}, legs-loss{extra}: {words or 'torch stays'}", flush=True)
            results.append(bool(changed))
    return results


def pythons() -> Dict[str, str]:
    """Return the interpreters of this machine that any of the torches has wheels for, by version."""
    found = {}
    root = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    for version in sorted({version for versions in TORCH.values() for version in versions}):
        installed = sorted(root.glob(f"{version}.*/bin/python{version}"))
        python = str(installed[-1]) if installed else shutil.which(f"python{version}")
        if python and subprocess.run([python, "-c", ""], stderr=subprocess.DEVNULL).returncode == 0:
            found[version] = python
    return found


def environment(folder: Path, python: str) -> List[str]:
    """Make a virtual environment with the newest pip of its Python; return the command that runs that pip."""
    subprocess.run([python, "-m", "venv", str(folder)], check=True)
    pip = [str(folder / "bin" / "python"), "-m", "pip", "--disable-pip-version-check", "--quiet"]
    subprocess.run([*pip, "install", "--upgrade", "pip"], check=True)
    return pip


def stub(folder: Path, name: str, version: str) -> str:
    """Write a wheel that holds nothing but a distribution's name and version; return its path."""
    path = folder / f"{name}-{version}-py3-none-any.whl"
    info = f"{name}-{version}.dist-info"
    with zipfile.ZipFile(path, "w") as wheel:
        wheel.writestr(f"{info}/METADATA", f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
        wheel.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        wheel.writestr(f"{info}/RECORD", "")
    return str(path)


def install(pip: List[str], wheels: List[str]) -> None:
    """Install wheels as they are, in place of other versions of the same distributions."""
    subprocess.run([*pip, "install", "--no-index", "--no-deps", "--force-reinstall", *wheels], check=True)


def resolve(pip: List[str], requirement: str, report: Path) -> Dict[str, str]:
    """Return the name and version of each distribution that pip would install for a requirement."""
    subprocess.run([*pip, "install", "--dry-run", "--report", str(report), requirement], check=True)
    plan = json.loads(report.read_text(encoding="utf-8"))["install"]
    return dict(name_and_version(entry["metadata"]) for entry in plan)


def name_and_version(metadata: Dict[str, str]) -> Tuple[str, str]:
    """Return a distribution's normalised name, and its version."""
    return metadata["name"].lower().replace("_", "-"), metadata["version"]


if __name__ == "__main__":
    sys.exit(main())
