"""The metadata beyond pyproject.toml: the licence for old and new setuptools, and README as a package index shows it.

setuptools 77 and later writes the licence as an SPDX expression (PEP 639) and is to refuse every other form; the last
setuptools of Python 3.7 and 3.8 knows only the older field.
"""

import re
from pathlib import Path
from typing import Dict

import setuptools

ROOT = Path(__file__).resolve().parent
LICENCE = "Apache-2.0"


def licence() -> Dict[str, str]:
    """Return the licence under the field that this setuptools knows."""
    knows_spdx = int(setuptools.__version__.split(".")[0]) >= 77
    return {"license_expression" if knows_spdx else "license": LICENCE}


def long_description() -> str:
    """Return README with links that hold outside the repository.

    They lead to the version's tag at the address that pyproject.toml gives as Source under [project.urls]. Without
    such an address a relative link becomes its text, and a picture is left out.
    """
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    version = re.search(r'"(.+?)"', (ROOT / "legs_loss" / "_version.py").read_text().split("__version__")[1])
    source = re.search(r'^Source = "(.+?)/?"', project, re.MULTILINE)
    assert version is not None
    relative = r"\[([^\]]*)\]\((?!https?:|#)([^)]+)\)"
    if source is None:
        text = re.sub(rf"^!{relative}\n\n?", "", text, flags=re.MULTILINE)
        return re.sub(relative, r"\1", text)
    home, tag = source.group(1), f"v{version.group(1)}"
    text = re.sub(rf"!{relative}", rf"![\1]({home}/raw/{tag}/\2)", text)
    return re.sub(relative, rf"[\1]({home}/blob/{tag}/\2)", text)


setuptools.setup(long_description=long_description(), long_description_content_type="text/markdown", **licence())
