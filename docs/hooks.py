"""Hooks of the documentation site: on it, the repository is not around the pages."""

from __future__ import annotations

import os
import re
from typing import Any


def on_page_markdown(markdown: str, page: Any, config: Any, **_: Any) -> str:
    """Drop links to folders and to files outside of docs/; their text stays."""
    here = os.path.dirname(page.file.abs_src_path)

    def kept(link: re.Match[str]) -> str:
        target = os.path.normpath(os.path.join(here, link.group(2).split("#")[0]))
        inside = target.startswith(config["docs_dir"] + os.sep)
        return link.group(0) if inside and not os.path.isdir(target) else link.group(1)

    return re.sub(r"(?<!!)\[([^\]]*)\]\((?!https?:|#)([^)\s]+)\)", kept, markdown)
