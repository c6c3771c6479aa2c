"""Say what may be the loss where no photometric L1 was found: a skipped line, or what the checkout trains with."""

from __future__ import annotations

import contextlib
import re
from pathlib import Path
from typing import Dict, Iterator, Pattern, Sequence

from legs_adapters.code.folders import first_of, walk
from legs_adapters.lexicon.names import is_of_other_framework, kind_of_words
from legs_adapters.terms.findings import Findings
from legs_loss.system.files import read_regular

_OF_PICTURES = re.compile(r"rgb|im(g|age)|colou?r|delta", re.I)
_SQUARED = "a squared loss of images was found here, which is not weighted"
_CHOSEN = "the loss seems to be chosen here, by {}: name the line that calls it with --site"
_LOSS = r"\b\w*(?:loss|criteri)\w*"
_SETTINGS = r"(cfg|conf\w*|opt|args|settings)"
_INSTEAD = (
    (r"^[ \t]*(import|from) (jax|mlx)\b", "JAX or MLX is imported, and legs_loss is written in torch"),
    (
        r"\bsuper\(\)\.get_loss_dict\(|^class \w+\([\w.]*\bSplatfactoModel\b",
        "the loss seems to be nerfstudio's own: its hook is `ns-train splatfacto-legs`",
    ),
    (
        r"\b\w*(l1\w*ssim|ssim\w*l1)\w*\(",
        "one function seems to compute L1 and SSIM, perhaps a compiled kernel: take both apart, and weight the L1",
    ),
    (r"mse_loss\w*\(|\bMSELoss\(|\bimg2mse\(|\bl2_loss\(|\) ?\*\* ?2\b|delta ?\*\* ?2", _SQUARED),
    (
        rf"(?i:\bgetattr\({_LOSS}, ?\w|{_LOSS}\[[^\]\"':]*\b{_SETTINGS}\b|\bglobals\(\)\[[^\"'\]]*loss"
        r"|\beval\([^)\n]*loss|\binstantiate\([^)\n]*(loss|criteri)|\bimport_module\([^)\n]*loss"
        rf"|\b(build|make|get|create)_\w*(loss|criteri)\w*\([^)\n]*\b{_SETTINGS}\b)",
        _CHOSEN.format("a setting"),
    ),
    (
        rf"(?i:(?<![\w@.]){_LOSS}(\[[^\]\"'\d:]+\]|\.get\([^\"'()][^()]*\))\s*\("
        r"|\b\w*REGISTRY\w*\.(get|build)\()|= *[A-Z_]*(LOSS|CRITERI)[A-Z_]*\[[\w.]+\] *$"
        r"|\b\w*(Loss|Criterion)\w*\.(L1|MAE|PHOTO\w*)\b|^class \w*(Loss|Criterion)\w*\([^)\n]*Enum\)"
        r"|(?:[\"'\w\])] *: *|\bdict\([^)\n]*= *|= *(?:functools\.)?(?:partial|member|staticmethod)\(|\bmap\()"
        r"(?:functools\.)?(?:partial\()?(?:[\w.]+\.)?(?:l1_loss\b(?!\()|L1Loss\()|= *[\"']l1_loss[\"'] *$",
        _CHOSEN.format("an entry of a table, a registry or an Enum"),
    ),
    (
        r"loss_sds|\bsds_loss|guidance\w*(\.train_step)?\(",
        "a gradient by a diffusion model (SDS) seems to be used, of no photograph",
    ),
)
_BY_CHOICE = [row for row in _INSTEAD if row[1].startswith(_CHOSEN[:20])]
# In YAML, JSON or TOML: an L1 as the value of a key of losses, or of a kind, a few lines below such a key.
_L1_VALUE = r"[\"']?\s*[:=]\s*[\"']?(?:[\w.]+\.)?(?:l1|l1[_-]?loss|mae|photometric\w*)\b"
_KIND = rf"\b(?:type|name|kind|_target_){_L1_VALUE}"
_IN_SETTINGS = (
    rf"(?i){_LOSS}{_L1_VALUE}|_target_[\"']?\s*[:=]\s*[\"']?[\w.]*L1Loss\b|{_LOSS}[\"']?\s*[:=]\s*{{[^}}\n]*{_KIND}"
    rf"|{_LOSS}[\"']?\]?\s*[:=]?\s*[\[{{]?[ \t]*\r?\n(?:[^\n]*\n){{0,3}}?[^\n]*{_KIND}"
)
_MOST_SETTINGS, _LARGEST = 500, 1 << 17  # files, and bytes of each
_MOST_SIGNS = 200  # of what a pattern repeats: a stranger's file has lines of a megabyte


def _bounded(pattern: str) -> Pattern[str]:
    """Compile a pattern whose time grows with the text, not with its square."""
    most = {"*": f"{{0,{_MOST_SIGNS}}}", "+": f"{{1,{_MOST_SIGNS}}}"}
    return re.compile(re.sub(r"(?<!\\)[*+]", lambda sign: most[sign.group()], pattern), re.M)


def offered(findings: Findings, command: str = "") -> str:
    """Say how to name the term: by the lines that were skipped, those first that speak of images."""
    skipped = [left for left in findings.left if left.rule not in ("", "definition")]
    # There --site would write torch.
    skipped = [left for left in skipped if not is_of_other_framework(findings.program.sources[left.path].text)]
    skipped.sort(key=lambda left: "image" not in map(kind_of_words, re.findall(r"\w+", left.text)))
    lines = dict.fromkeys(f"{command}--site {left.path}:{left.line}" for left in skipped)
    if not lines:
        return f"if there is one, name it with {command}--site FILE:LINE"
    return f"if a skipped line is the loss, take it with {first_of(list(lines), 3, ' or ')}"


def trained_instead(root: Path, exclude: Sequence[str], findings: Findings) -> Iterator[str]:
    """Yield ``file:line: what`` for each row of the table that the files speak of, and for an L1 that settings name.

    Beside a weighted term it is where the files choose a loss that train and have none.
    """
    files = sorted(findings.program.sources.values(), key=lambda source: (source.path.count("/"), source.path))
    is_decided = bool(findings.sites or findings.patched)
    files = [source for source in files if not is_decided or source.path in findings.unsettled]
    said: Dict[str, str] = {}  # of rows for one place the first
    for pattern, what in _INSTEAD if not is_decided else _BY_CHOICE:
        found = ((source, hit) for source in files for hit in _bounded(pattern).finditer(source.text))
        for source, hit in found:
            before = source.text[max(0, hit.start() - _MOST_SIGNS) : hit.start()].rpartition("\n")[2]
            line = (before + source.text[hit.start() : hit.end() + _MOST_SIGNS].partition("\n")[0]).lstrip()
            of_images = _OF_PICTURES.search(line) and "loss" in (line.replace(hit.group(), "") + source.path).lower()
            if not line.startswith(("#", "def ")) and (of_images or what is not _SQUARED):
                said.setdefault(f"{source.path}:{source.text.count(chr(10), 0, hit.start()) + 1}", what)
                break
    yield from (f"{place}: {what}" for place, what in said.items())
    for path in [] if is_decided else list(walk(root, exclude, (".yaml", ".yml", ".json", ".toml")))[:_MOST_SETTINGS]:
        with contextlib.suppress(OSError):  # larger, or no file
            text = read_regular(root / path, _LARGEST).decode("utf-8", "replace")
            named = _bounded(_IN_SETTINGS).search(text)
            if named is not None:
                yield f"{path}:{text.count(chr(10), 0, named.end()) + 1}: {_CHOSEN.format('settings')}"
                break
