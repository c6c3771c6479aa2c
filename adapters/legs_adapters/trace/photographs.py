"""Tell which image file a picture is, by thumbnails: whatever resizing, mask, exposure or layout came between."""

from __future__ import annotations

import functools
import os
import re
from pathlib import Path
from typing import Any, Dict, List, NamedTuple, Optional, Sequence, Set, Tuple

from legs_loss import LegsError

SIDE = 16  # cells of a thumbnail
_FINE = 4  # parts of a cell, each way
_PARTS = SIDE * _FINE  # of a picture, each way
SURE = 0.94  # the correlation from which on a picture is a file's
DETAIL = 0.6  # that of what the parts of cells have beside it: less is a rendering, or another view
MAX_FILES = 4000
_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff", ".ppm")
_OTHER = re.compile(  # the words of a folder, or of a file's name, whose pictures are no photographs
    r"(?i)(^|[^a-z])(normals?|nrm|depths?|disp|disparity|masks?|seg|segmentations?|semantics?|labels?|flow|edges?|"
    r"renders?|renderings?|features?|albedo|alpha|matte|monodepth|omnidata|dsine|teacher|pseudo|generated)([^a-z]|$)"
)
_PHOTOS = re.compile(r"(?i)(^|[^a-z])(images?|rgb|colou?rs?|photos?|photographs?|frames|inputs?|train)([^a-z]|$)")
_GREY = 0.1  # the part of a file's colours from which on a picture is no grey copy of it

_EQUAL, _REST = 0.2, 0.005  # equal pixels of a part of a photograph; the variance that an exposure leaves, at most


class Picture(NamedTuple):
    """The means of the parts of a picture's cells [3, 256, 16], which of them are no background, its size up to 64."""

    parts: Any
    kept: Any
    size: Tuple[int, int]


class Match(NamedTuple):
    """The image file that a picture is most like.

    Attributes:
        path: the file.
        correlation: of the two, by thumbnails.
        is_photograph: whether the file is one, and the picture no grey copy of it.
        detail: the correlation of what larger thumbnails have beside it.
    """

    path: str
    correlation: float
    is_photograph: bool
    detail: float = 1.0


class Photographs:
    """The image files under some folders: those that the scenes' models list, and all others.

    Args:
        folders: the folders that the command names.
        photos: a folder of photographs by the user's word; the models are not asked then.
    """

    def __init__(self, folders: Sequence[str], photos: Optional[str] = None) -> None:
        roots = [photos] if photos else list(folders)
        self.root: str = os.path.commonpath([os.path.realpath(root) for root in roots]) if roots else ""
        files = list(dict.fromkeys(path for root in roots for path in _image_files(root)))[:MAX_FILES]
        listed: Dict[str, Set[Tuple[str, str]]] = {}  # by folder what the model in it lists
        for folder in {folder for path in files if not photos for folder in self._folders(path)}:
            listed[folder] = _listed(folder)
        every = set().union(*listed.values())
        self._tiers: List[List[str]] = [[], []]
        for path in files:
            inside, has_model = os.path.relpath(path, self.root), any(map(listed.get, self._folders(path)))
            is_other = has_model or _OTHER.search(inside) or (every and not _PHOTOS.search(inside))
            self._tiers[bool(is_other) and _key(path) not in every and not photos].append(path)

    def __len__(self) -> int:
        return sum(map(len, self._tiers))

    def _folders(self, path: str) -> List[str]:
        """Return the folders that a file lies in, up to the one that all files have."""
        return [str(folder) for folder in Path(path).parents if len(str(folder)) >= len(self.root)]

    def match(self, picture: Optional[Picture]) -> Optional[Match]:
        """Return the file that a picture's thumbnail is most like: a photograph first; None without files."""
        if picture is None:
            return None
        best = self._best(0, picture)
        if best is None or best[0].correlation < SURE:
            found = [each for each in (best, self._best(1, picture)) if each is not None]
            best = max(found, key=lambda each: each[0].correlation, default=None)
        if best is None or best[0].correlation < SURE:
            return best and best[0]
        (match, file), (parts, kept, size) = best, picture
        is_small = min(size) < 2 * SIDE  # without detail
        detail = 1.0 if is_small else float(_likeness(_high(parts, kept), _high(file, kept))[0])
        if detail < DETAIL:
            return match._replace(correlation=min(match.correlation, SURE * max(detail, 0.0)))
        is_grey = _colours(_cells(parts, kept)) + 1e-4 < _GREY * _colours(_cells(file, kept)[0])
        return match._replace(detail=detail, is_photograph=match.is_photograph and not is_grey)

    def _best(self, tier: int, picture: Picture) -> Optional[Tuple[Match, Any]]:
        """Return the file that a picture's cells are most like, and its parts [1, 3, 256, 16]."""
        import numpy as np

        parts, kept, size = picture
        files, stack = _thumbnails(tuple(self._tiers[tier]), size)
        if not files:
            return None
        scores = _likeness(_cells(parts, kept), _cells(stack, kept))
        at = int(np.argmax(scores))
        return Match(os.path.relpath(files[at], self.root), float(scores[at]), not tier), stack[at : at + 1]


def _colours(thumb: Any) -> float:
    """Return how far a thumbnail's channels are from each other."""
    return float((thumb - thumb.mean(0)).std())


def _likeness(picture: Any, files: Any) -> Any:
    """Return the correlations of a picture [3, k] with those of files [F, 3, k], in RGB or BGR."""
    import numpy as np

    centred = [each - each.mean(-1, keepdims=True) for each in (picture, files)]
    one, others = (each / np.maximum(np.sqrt((each**2).sum((-1, -2), keepdims=True)), 1e-3) for each in centred)
    others = others.reshape(len(others), -1)
    return np.maximum(others @ one.ravel(), others @ one[::-1].ravel())


def thumbnail(picture: Any) -> Optional[Picture]:
    """Return a picture's means over parts of its cells, and which have nothing of a background of one colour.

    Args:
        picture: a tensor, [3, H, W], [H, W, 3], or of such a batch; of one of four channels the first three. Of a batch
            the first.

    Returns:
        None for what is no picture of three or four channels.
    """
    import numpy as np
    import torch
    from torch.nn.functional import adaptive_max_pool2d, max_pool2d

    image = as_planes(picture.detach())
    if image is None:
        return None
    with torch.no_grad(), torch.autocast(image.device.type, enabled=False):
        image = torch.nan_to_num(image[:3].float())
        high, low = adaptive_max_pool2d(image, SIDE), -adaptive_max_pool2d(-image, SIDE)
        flat = high[:, (high - low).amax(0) < 1e-6]  # the colours of cells of one colour
        ground = flat.median(1).values[:, None, None] if flat.numel() else image.new_zeros(1)
        equal = [((image - each).abs() < 1e-6).all(0) for each in (image.new_zeros(1), image.new_ones(1), ground)]
        near = max_pool2d(torch.stack(equal).any(0)[None].float(), 3, 1, 1)  # and what is blurred at its border
        parts, kept = _pooled(image), _pooled(near)[0] < 1e-6
    size = min(image.shape[1], _PARTS), min(image.shape[2], _PARTS)
    return Picture(parts, kept if _inside(kept).sum() >= 16 else np.ones_like(kept), size)


def _pooled(image: Any) -> Any:
    """Return the means over the parts of the cells of an image [C, H, W], as an array [C, 256, 16]."""
    parts = _resampled(image, (_PARTS, _PARTS)).reshape(len(image), SIDE, _FINE, SIDE, _FINE)
    return parts.transpose(2, 3).reshape(len(image), SIDE**2, _FINE**2).cpu().numpy()


def _resampled(image: Any, size: Tuple[int, int]) -> Any:
    """Return the means over equal parts of an image [C, H, W], exact at their borders."""
    import torch

    both = zip(image.shape[1:], size)
    rows, columns = (torch.as_tensor(_areas(count, side), device=image.device) for count, side in both)
    return rows @ image @ columns.t()


def _inside(kept: Any) -> Any:
    """Return the cells of which at least half is kept."""
    return kept.mean(-1) >= 0.5


def _cells(parts: Any, kept: Any) -> Any:
    """Return the means [..., k] of what is kept of the cells of which at least half is."""
    import numpy as np

    weights = kept / np.maximum(kept.sum(-1, keepdims=True), 1)
    return np.einsum("...cp,cp->...c", parts, weights.astype(parts.dtype))[..., _inside(kept)]


def _high(parts: Any, kept: Any) -> Any:
    """Return what is kept of parts [..., 256, 16], without the means of their cells, as [..., k]."""
    inside = _inside(kept)
    return (parts[..., inside, :] - _cells(parts, kept)[..., None])[..., kept[inside]]


def _areas(count: int, side: int) -> Any:
    """Return the weights [side, count] of the means over equal parts of a row of pixels."""
    import numpy as np

    edges = np.linspace(0, count, side + 1)
    pixels = np.arange(count)
    low, high = np.maximum(edges[:-1, None], pixels), np.minimum(edges[1:, None], pixels + 1)
    return (np.maximum(high - low, 0) * (side / count)).astype(np.float32)


def as_planes(tensor: Any) -> Optional[Any]:
    """Return the first picture of a tensor as [C, H, W], C three or four; None where it has none."""
    while tensor.dim() > 3:
        tensor = tensor[0]
    if tensor.dim() != 3 or not tensor.is_floating_point() or min(tensor.shape) < 1:
        return None
    if tensor.shape[0] in (3, 4) and min(tensor.shape[1:]) > 4:
        return tensor
    return tensor.permute(2, 0, 1) if tensor.shape[-1] in (3, 4) and min(tensor.shape[:2]) > 4 else None


def uncut(picture: Any) -> Optional[Any]:
    """Return the whole picture [C, H, W] of which a tensor was cut out by its indices; None where that is not known."""
    planes = as_planes(picture)
    base = None if planes is None else planes._base
    if planes is None or base is None or any(base.stride().count(step) != 1 for step in planes.stride()):
        return None
    sizes, steps = dict(zip(base.stride(), base.shape)), planes.stride()[1:]
    at = planes.storage_offset() - base.storage_offset()
    first = planes.storage_offset() - sum(at // step % sizes[step] * step for step in steps)
    whole = base.as_strided((len(planes), *(sizes[step] for step in steps)), planes.stride(), first)
    return None if whole.shape == planes.shape else whole


def is_another(picture: Any, best: Any) -> bool:
    """Return whether a picture is no part of another one, under a mask say, and no exposure of it: a rendering.

    The pictures are [C, H, W], in [0, 1]; an exposure is a polynomial of second degree of the three colours.
    """
    import torch

    if picture.shape != best.shape:
        return False
    one, other = (each[:3].double().reshape(3, -1) for each in (picture, best))
    inside = ((one > 0) & (one < 1) & (other > 0) & (other < 1)).all(0)
    one, other = one[:, inside], other[:, inside]
    if one.shape[1] < 64 or float((one == other).all(0).double().mean()) > _EQUAL:
        return False
    terms = torch.cat([other, other**2, torch.ones_like(other[:1])])
    matrix = terms @ terms.t() + 1e-9 * torch.eye(7, dtype=terms.dtype, device=terms.device)
    rest = one - torch.linalg.solve(matrix, terms @ one.t()).t() @ terms
    return float((rest**2).mean()) > _REST * float(((one - one.mean(1, keepdim=True)) ** 2).mean())


def _image_files(root: str) -> List[str]:
    found: List[str] = []
    for folder, folders, names in os.walk(root):
        folders[:] = sorted(name for name in folders if not name.startswith(".") and name != "legs_weights")
        found += [os.path.join(folder, name) for name in sorted(names) if name.lower().endswith(_SUFFIXES)]
        folders[:] = folders if len(found) <= MAX_FILES else []
    return found


def _listed(root: str) -> Set[Tuple[str, str]]:
    """Return the photographs that a scene's model lists, each as its folder without `_4` and its stem."""
    from legs_loss.scenes import read_scene

    if not any(name == "sparse" or re.match(r"transforms.*\.json$", name) for name in os.listdir(root)):
        return set()
    try:
        return {_key(str(view.path)) for view in read_scene(root).views}
    except LegsError:
        return set()


def _key(path: str) -> Tuple[str, str]:
    folder, name = os.path.split(os.path.realpath(path))
    return re.sub(r"_\d+$", "", folder), os.path.splitext(name)[0]


@functools.lru_cache(maxsize=None)
def _thumbnails(files: Tuple[str, ...], size: Tuple[int, int]) -> Tuple[Sequence[str], Any]:
    """Return the files that could be read, and their parts [F, 3, 256, 16], as coarse as a picture of that size."""
    import numpy as np
    import torch
    from PIL import Image

    found: Dict[str, Any] = {}
    for path in files:
        try:
            with Image.open(path) as image:
                image.draft("RGB", (4 * _PARTS, 4 * _PARTS))  # of a JPEG: decoded smaller
                pixels = torch.as_tensor(np.array(image.convert("RGB"), np.float32)).permute(2, 0, 1) / 255
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
            continue
        found[path] = _pooled(_resampled(pixels, size))
    return list(found), np.stack(list(found.values())) if found else None
