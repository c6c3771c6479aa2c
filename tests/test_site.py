"""The documentation site builds without a warning, its reference is whole, and its notebook runs."""

from __future__ import annotations

import importlib
import json
import os
import shutil
import subprocess
import sys
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

import legs_loss
from tests.support import ROOT, legs_environment


def test_the_reference_has_every_public_name():
    text = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    shown = {line.split(".")[-1] for line in text.splitlines() if line.startswith("::: ")}
    for line in text.splitlines():  # each stands where the page says
        if line.startswith("::: "):
            module, _, name = line[4:].rpartition(".")
            assert name in vars(importlib.import_module(module)), line
    data = {"OPERATORS", "PRESETS", "METRICS", "__version__"}
    assert set(legs_loss.__all__) - data <= shown


@pytest.mark.slow
class TestSite:
    @pytest.fixture(scope="class")
    def site(self, tmp_path_factory: pytest.TempPathFactory) -> Path:
        for package in ("mkdocs", "material", "mkdocstrings", "mkdocs_jupyter"):
            pytest.importorskip(package)
        out = tmp_path_factory.mktemp("site")
        command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--site-dir", str(out)]
        environment = dict(os.environ, NO_MKDOCS_2_WARNING="1")
        done = subprocess.run(command, cwd=str(ROOT), env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr[-3000:]  # strict: every warning is an error
        return out

    def test_pages_hold_what_they_are_for(self, site):
        reference = (site / "api.html").read_text(encoding="utf-8")
        for name in ("l1_loss", "WeightSpec", "register_curve", "percentile"):
            assert name in reference
        assert ":func:<code>" not in reference
        assert "<blockquote>" not in reference  # a doctest that is no code
        assert "data:image/png;base64" in (site / "decision.html").read_text(encoding="utf-8")
        start = (site / "index.html").read_text(encoding="utf-8")
        assert start.index("legs-patch") < start.index("legs run")
        listed = (site / "compatibility.html").read_text(encoding="utf-8")
        rows = (ROOT / "docs/compatibility/corpus.csv").read_text(encoding="utf-8").splitlines()
        assert listed.partition('id="codebases"')[2].count("<tr>") == len(rows)
        for page in site.glob("**/*.html"):
            text = page.read_text(encoding="utf-8")
            assert "<th></th>\n</tr>" not in text, f"{page}: a table without heads"
            for host in ("fonts.googleapis.com", "unpkg.com/mermaid"):
                assert host not in text, page

    def test_the_search_works_where_the_page_is_opened_from_the_disk(self, site, browser):
        page = browser.new_page()
        troubles = []
        page.on("pageerror", lambda error: troubles.append(str(error)))
        page.goto((site / "index.html").as_uri())
        page.keyboard.press("f")
        page.locator("input.md-search__input").first.type("precompute", delay=50)
        page.wait_for_selector(".md-search-result__item", state="attached", timeout=60_000)
        assert troubles == []
        page.close()

    def test_what_is_not_found_leads_back_from_any_folder_of_any_host(self, site, browser, tmp_path):
        shutil.copytree(str(site), str(tmp_path / "below" / "legs"))

        class Host(SimpleHTTPRequestHandler):
            def send_error(self, code, *more):
                self.send_response(code)
                self.end_headers()
                self.wfile.write((site / "404.html").read_bytes() if self.command == "GET" else b"")

        server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Host, directory=str(tmp_path)))
        threading.Thread(target=server.serve_forever, daemon=True).start()
        page = browser.new_page()
        for lost in ("nothing.html", "evidence/deep/nothing"):
            page.goto(f"http://127.0.0.1:{server.server_port}/below/legs/{lost}")
            page.wait_for_function("document.getElementById('start').href.endsWith('/below/legs/index.html')")
        page.click("#start")
        assert page.title() == "legs-loss"
        page.close()
        server.shutdown()
        server.server_close()

    def test_no_page_is_wider_than_a_telephone(self, site, browser):
        page = browser.new_page(viewport={"width": 400, "height": 900})
        for name in ("index", "patching", "evidence", "cpu", "masks", "api", "codebases/fastgs"):
            page.goto((site / f"{name}.html").as_uri())
            assert page.evaluate("document.documentElement.scrollWidth") <= 400, name
        page.close()


@pytest.mark.slow
def test_the_notebook_runs_and_comes_to_a_decision(tmp_path, monkeypatch):
    nbformat = pytest.importorskip("nbformat")
    client = pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    pytest.importorskip("matplotlib")
    notebook = nbformat.read(str(ROOT / "docs" / "decision.ipynb"), as_version=4)
    monkeypatch.setenv("PYTHONPATH", legs_environment()["PYTHONPATH"])
    client.NotebookClient(notebook, timeout=900, kernel_name="python3").execute(cwd=str(tmp_path))
    text = json.dumps([cell.get("outputs") for cell in notebook.cells])
    assert "at equal numbers" in text
    assert "legs@3dgs" in text
