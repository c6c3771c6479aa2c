"""Write pictures atomically, since a truncated sheet would look complete, and names on them as they are."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Union

from legs_loss.errors import LegsError
from legs_loss.system.files import write_whole
from legs_loss.system.terminal import printable


def label(name: str) -> str:
    r"""Return a name escaped for matplotlib, which draws it literally.

    >>> print(label("a$b\x07.png"))
    a\$b\x07.png
    """
    return printable(name, lines=True).replace("$", r"\$")


def save_figure(figure: Any, path: Union[str, Path], dpi: int) -> None:
    """Write a figure of matplotlib; the name's suffix selects the format.

    Raises:
        LegsError: matplotlib does not know the format, or the file cannot be written.
    """
    form, known = Path(path).suffix[1:].lower() or "png", figure.canvas.get_supported_filetypes()
    if form not in known:
        raise LegsError(f"cannot write {path}: matplotlib writes {', '.join(known)}, not {form}")
    write_whole(path, lambda file: figure.savefig(file, format=form, dpi=dpi, facecolor="white"))
