"""Hooks of the documentation site: on it, the repository is not around the pages."""

from __future__ import annotations

import csv
import html
import os
import re
from pathlib import Path
from typing import Any

FILTER = """document.querySelector(".filter").addEventListener("input", (event) => {
  const word = event.target.value.toLowerCase();
  for (const row of document.querySelectorAll("#codebases tbody tr"))
    row.hidden = !row.textContent.toLowerCase().includes(word);
});"""


def on_page_markdown(markdown: str, page: Any, config: Any, **_: Any) -> str:
    """Drop links to folders and to files outside of docs/; their text stays."""
    here = os.path.dirname(page.file.abs_src_path)

    def kept(link: re.Match[str]) -> str:
        target = os.path.normpath(os.path.join(here, link.group(2).split("#")[0]))
        inside = target.startswith(config["docs_dir"] + os.sep)
        return link.group(0) if inside and not os.path.isdir(target) else link.group(1)

    return re.sub(r"(?<!!)\[([^\]]*)\]\((?!https?:|#)([^)\s]+)\)", kept, markdown)


def on_page_content(content: str, page: Any, config: Any, **_: Any) -> str:
    """Show names that docstrings refer to as code, and append to its page the table of codebases with a filter."""
    content = re.sub(r":\w+:<code>~?(?:[\w.]+\.)?(\w+)</code>", r"<code>\1</code>", content)  # `:func:` is Sphinx's
    if page.file.src_uri != "compatibility.md":
        return content
    with Path(config["docs_dir"], "compatibility", "corpus.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    keys = ("codebase", "kind", "first", "now", "sites", "note")
    head = "".join(f"<th>{key}</th>" for key in keys)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(row[key])}</td>" for key in keys) + "</tr>" for row in rows)
    return (
        f'{content}<h2 id="all">All of them</h2><div data-search-exclude><input class="filter" type="search" '
        f'aria-label="Filter the codebases" placeholder="filter: a name, a kind, a verdict"><table id="codebases">'
        f"<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div><script>{FILTER}</script>"
    )


def on_post_build(config: Any, **_: Any) -> None:
    """Write the index of the search as a script, too: a page that is opened from the disk cannot read the other."""
    index = Path(config["site_dir"], "search", "search_index.json")
    index.with_suffix(".js").write_text(f"var __index = {index.read_text(encoding='utf-8')}", encoding="utf-8")
    # Without an address of the site the page for what is not found links to the root of the host.
    lost = Path(config["site_dir"], "404.html")
    if lost.is_file():
        text = re.sub(r'(href|src)="/(?!/)', r'\1="./', lost.read_text(encoding="utf-8"))
        lost.write_text(text.replace('"base": "/"', '"base": "."'), encoding="utf-8")
