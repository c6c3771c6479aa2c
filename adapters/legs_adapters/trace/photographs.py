"""Tell which image file a picture is, by thumbnails: whatever resizing, mask, exposure or layout came between."""

from __future__ import annotations

import functools
import os
import re
from pathlib import Path
from typing import Any, Dict, List, NamedTuple, Optional, Sequence, Set, Tuple

from legs_loss import LegsError

SIDE = 16  # pixels of a thumbnail
SURE = 0.94  # the correlation from which on a picture is a file's
DETAIL = 0.6  # that of what thumbnails four times as large have beside it: less is a rendering, or another view
MAX_FILES = 4000
Picture = Tuple[Any, Any, Optional[Any], Tuple[int, ...]]
_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff", ".ppm")
_OTHER = re.compile(  # the words of a folder, or of a file's name, whose pictures are no photographs
    r"(?i)(^|[^a-z])(normals?|nrm|depths?|disp|disparity|masks?|seg|segmentations?|semantics?|labels?|flow|edges?|"
    r"renders?|renderings?|features?|albedo|alpha|matte|monodepth|omnidata|dsine|teacher|pseudo|generated)([^a-z]|$)"
)
_PHOTOS = re.compile(r"(?i)(^|[^a-z])(images?|rgb|colou?rs?|photos?|photographs?|frames|inputs?|train)([^a-z]|$)")
_GREY = 0.1  # the part of a file's colours from which on a picture is no grey copy of it

_EQUAL, _REST = 0.2, 0.005  # equal pixels of a part of a photograph; the variance that an exposure leaves, at most


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
        if best is None or best.correlation < SURE:
            found = [match for match in (best, self._best(1, picture)) if match is not None]
            best = max(found, key=lambda match: match.correlation, default=None)
        if best is None or best.correlation < SURE:
            return best
        path = os.path.join(self.root, best.path)
        detail = self._detail(path, picture)
        if detail < DETAIL:
            return best._replace(correlation=min(best.correlation, SURE * max(detail, 0.0)))
        kept = picture[1]
        most = max(_colours(thumb[:, kept]) for thumb in _thumbnails((path,))[1])
        is_grey = _colours(picture[0][:, kept]) + 1e-4 < _GREY * most
        return best._replace(detail=detail, is_photograph=best.is_photograph and not is_grey)

    def _detail(self, path: str, picture: Picture) -> float:
        """Return the correlation with a file's detail; 1 where the picture is too small to have any."""
        import numpy as np

        kept, fine = picture[1:3]
        if fine is None:
            return 1.0
        scale = round((fine.shape[1] / kept.size) ** 0.5)
        inside = kept.reshape(SIDE, SIDE).repeat(scale, 0).repeat(scale, 1).ravel()
        one = _standardised(fine[:, inside]).ravel()
        scores = [_standardised(_high(other, scale)[:, inside]) for other in _thumbnails((path,), scale * SIDE)[1]]
        return max((float(np.dot(score[::way].ravel(), one)) for score in scores for way in (1, -1)), default=0.0)

    def _best(self, tier: int, picture: Picture) -> Optional[Match]:
        import numpy as np

        files, stack = _thumbnails(tuple(self._tiers[tier]))  # [F], [F, 3, 256]
        thumb, kept, _, shape = picture
        if not len(files) or kept.sum() < 16:
            return None
        one = _standardised(thumb[:, kept])
        if min(shape) < SIDE:  # the files as coarse as the picture is
            rows, columns = (_areas(n) @ _areas(SIDE, n) if n < SIDE else np.eye(SIDE) for n in shape)
            stack = (rows @ stack.reshape(-1, 3, SIDE, SIDE) @ columns.T).reshape(stack.shape)
        others = _standardised(stack[:, :, kept])
        scores = np.maximum(others @ one.ravel(), others @ one[::-1].ravel())  # RGB, BGR
        at = int(np.argmax(scores))
        return Match(os.path.relpath(self._tiers[tier][files[at]], self.root), float(scores[at]), not tier)


def _colours(thumb: Any) -> float:
    """Return how far a thumbnail's channels are from each other."""
    return float((thumb - thumb.mean(0)).std())


def _standardised(thumbs: Any) -> Any:
    """Return thumbnails [..., 3, K] without their channels' means, of norm 1; several as rows."""
    import numpy as np

    centred = thumbs - thumbs.mean(-1, keepdims=True)
    norm = np.sqrt((centred**2).sum((-1, -2), keepdims=True))
    found = centred / np.maximum(norm, 1e-3)
    return found.reshape(len(found), -1) if found.ndim == 3 else found


def thumbnail(picture: Any) -> Optional[Picture]:
    """Return a picture's thumbnail [3, 256] in [0, 1] or so, what is no flat background, its detail, its size.

    Args:
        picture: a tensor, [3, H, W], [H, W, 3], or of such a batch; of one of four channels the first three. Of a batch
            the first.

    Returns:
        None for what is no picture of three or four channels.
    """
    import torch
    from torch.nn.functional import adaptive_max_pool2d, max_pool2d

    image = as_planes(picture.detach())
    if image is None:
        return None
    with torch.no_grad(), torch.autocast(image.device.type, enabled=False):
        image = torch.nan_to_num(image[:3].float())
        scale = min(4, min(image.shape[1:]) // SIDE)
        pool, fine = _pooled(image, SIDE), _pooled(image, scale * SIDE) if scale > 1 else None
        flat = (adaptive_max_pool2d(image, SIDE) + adaptive_max_pool2d(-image, SIDE)).amax(0, keepdim=True) < 1e-6
        near = max_pool2d(flat.float(), 3, 1, 1) > 0  # the cells at its border have a part of it
    kept = (~near if int((~near).sum()) >= 16 else ~flat).cpu().numpy().ravel()
    return pool, kept, None if fine is None else _high(fine, scale), tuple(image.shape[1:])


def _pooled(image: Any, side: int) -> Any:
    """Return the means over equal parts of an image [3, H, W], as an array [3, side * side]."""
    import torch

    rows, columns = (torch.as_tensor(_areas(n, side), device=image.device) for n in image.shape[1:])
    return (rows @ image @ columns.t()).reshape(3, -1).cpu().numpy().astype("float64")


def _high(thumb: Any, scale: int) -> Any:
    """Return a large thumbnail [3, n] without its means over cells of that many pixels."""
    cells = thumb.reshape(3, SIDE, scale, SIDE, scale)
    return (cells - cells.mean((2, 4), keepdims=True)).reshape(3, -1)


def _areas(count: int, side: int = SIDE) -> Any:
    """Return the weights [side, count] of the means over equal parts of a row of pixels, exact at their borders."""
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
def _thumbnails(files: Tuple[str, ...], side: int = SIDE) -> Tuple[Any, Any]:
    """Return the indices of the files that could be read, and thumbnails; of one with alpha on black and white too."""
    import numpy as np
    import torch
    from PIL import Image

    indices, thumbs = [], []
    for at, path in enumerate(files):
        try:
            with Image.open(path) as image:
                image.draft("RGB", (16 * SIDE, 16 * SIDE))  # of a JPEG: decoded smaller
                pictures = [image.convert("RGB")]
                for ground in ("black", "white") if image.mode in ("RGBA", "LA", "PA") else ():
                    pixels = image.convert("RGBA")
                    behind = Image.new("RGBA", pixels.size, ground)
                    pictures.append(Image.alpha_composite(behind, pixels).convert("RGB"))
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
            continue
        for picture in pictures:
            indices.append(at)
            thumbs.append(_pooled(torch.as_tensor(np.array(picture, np.float32)).permute(2, 0, 1) / 255, side))
    return np.asarray(indices, int), np.asarray(thumbs).reshape(-1, 3, side * side)
