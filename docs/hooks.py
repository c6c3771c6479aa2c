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

# A host shows it in place of a page in any folder, so it refers to no file, and looks for the site's folder upwards.
NOT_FOUND = """<!doctype html>
<html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>Not found - legs-loss</title>
<style>
:root { color-scheme: light dark }
body { font: 1.1rem/1.6 sans-serif; max-width: 34rem; margin: 15vh auto; padding: 0 1rem }
</style>
<h1>There is no such page</h1>
<p><a id="start" href="index.html">The first page of legs-loss</a> has a search and lists the others.</p>
<script>
(async () => {
  for (let at = new URL(".", location); ; at = new URL("..", at)) {
    const found = await fetch(new URL("objects.inv", at), {method: "HEAD"}).catch(() => ({}));
    if (found.ok) document.getElementById("start").href = new URL("index.html", at);
    if (found.ok || at.pathname === "/") return;
  }
})();
</script>
"""


def on_page_markdown(markdown: str, page: Any, config: Any, **_: Any) -> str:
    """Drop links to folders and to files outside of docs/; their text stays."""
    here = os.path.dirname(page.file.abs_src_path)

    def kept(link: re.Match[str]) -> str:
        target = os.path.normpath(os.path.join(here, link.group(2).split("#")[0]))
        inside = target.startswith(config["docs_dir"] + os.sep)
        return link.group(0) if inside and not os.path.isdir(target) else link.group(1)

    return re.sub(r"(?<!!)\[([^\]]*)\]\((?!https?:|#)([^)\s]+)\)", kept, markdown)


def _with_breaks(cell: re.Match[str]) -> str:
    """Let the code in a cell of a table break after a bracket, a dot, a stroke: a telephone is narrow."""
    return re.sub(r"<code>[^<]*", lambda code: re.sub(r"((?!\(\))[(_=./])", r"\1<wbr>", code.group()), cell.group())


def on_page_content(content: str, page: Any, config: Any, **_: Any) -> str:
    """Keep options on one line, show names of docstrings as code, and append the table of codebases to its page."""
    content = re.sub(r"<code>(--?\w[^<\s]{0,30})</code>", r'<code class="whole">\1</code>', content)  # an option
    content = re.sub(r"<t[dh][ >].*?</t[dh]>", _with_breaks, content, flags=re.S)
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
    Path(config["site_dir"], "404.html").write_text(NOT_FOUND, encoding="utf-8")
