"""The terms that a trace saw under a loss, and what decides of each whether it is photometric."""

from __future__ import annotations

from typing import Any, Dict, FrozenSet, Iterator, List, NamedTuple, Optional, Sequence, Tuple


class Frame(NamedTuple):
    """A place of the checkout on a difference's stack, in which function, and its names of the two sides, or "".

    ``span`` is the last line, and the first and last column in bytes, of the expression; empty before Python 3.11.
    """

    path: str
    line: int
    span: Sequence[int]
    name: str
    sides: Tuple[str, ...]


class Traced(NamedTuple):
    """A difference that lies under a loss, as it ran.

    Attributes:
        frames: of the checkout, innermost first.
        kind: "l1", "squared", "robust", "signed", "compiled: NAME", "distance: of any norm"; of legs_loss.l1_loss
            "weighted" or "plain".
        target: which operand is the side that wants no gradient; -1: both want one.
        shape: of that side.
        largest: its largest absolute value.
        share: its part of the loss.
        match: the image file that side is most like: "path", "correlation", "is_photograph"; None: there is no file, or
            the side is no picture of three or four channels.
        is_known: whether it is that file.
        is_rival: whether another term under the same loss has a picture that is more like that file, and this
            one is no part of it, nor an exposure: a rendering by a teacher, say.
        gaussians: how many Gaussians are stepped after it; 0 where that cannot be told.
        parameters, stepped: names and shapes of what is stepped after it.
        steps, poses: how many steps moved more than poses, exposures and embeddings; and how many only those.
        is_picture: whether that side is a picture of three or four channels.
        is_read: whether its gradient is of torch.autograd.grad, and was the ``grad`` of no leaf that was stepped.
        passes: under which losses it lay, by their numbers from 1.
    """

    frames: Tuple[Frame, ...]
    kind: str
    target: int
    shape: Tuple[int, ...]
    largest: float
    share: float
    match: Optional[Dict[str, Any]]
    is_known: bool
    is_rival: bool
    gaussians: int
    parameters: Sequence[str]
    stepped: Sequence[Sequence[int]]
    steps: int
    poses: int
    is_picture: bool
    is_read: bool = False
    passes: FrozenSet[int] = frozenset()

    @classmethod
    def read(cls, terms: Sequence[Dict[str, Any]]) -> Iterator[Traced]:
        """Yield those terms of a watched process's report after which something was stepped."""
        for term in (term for term in terms if term["steps"] or term["poses"]):
            frames = tuple(Frame(*frame) for frame in term["frames"])
            rest = {name: value for name, value in term.items() if name not in ("frames", "shares")}
            passes, shares = zip(*term["shares"])
            yield cls(frames=frames, share=sum(shares) / len(shares), passes=frozenset(passes) - {0}, **rest)

    @property
    def is_l1(self) -> bool:
        """Return whether it is an absolute difference, of a patch or not."""
        return self.kind == "l1" or self.is_patched

    @property
    def is_patched(self) -> bool:
        """Return whether it is a call of legs_loss.l1_loss."""
        return self.kind in ("weighted", "plain")

    @property
    def is_photometric(self) -> bool:
        """Return whether it is the L1 of a trained rendering and a photograph."""
        return self.is_l1 and not self.why_other

    @property
    def is_unknown(self) -> bool:
        """Return whether only its picture is unknown: it is of no image file."""
        return self.is_l1 and self.is_picture and self.steps > 0 and (self.is_rival or not self.is_known)

    @property
    def is_list(self) -> bool:
        """Return whether that side may be a list of pixels, as [3, 500] or [500, 3] is."""
        long = [side for side in self.shape if side > 1]
        return len(long) == 2 and bool({3, 4}.intersection(long))

    @property
    def why_other(self) -> str:
        """Return why it is not of a trained rendering and a photograph, in words; empty where it is."""
        if self.target < 0:
            return "both sides are trained"
        if not self.steps:
            return "only poses, exposures or embeddings are stepped after it"
        if not self.is_picture:
            what = "a list of pixels or points" if self.is_list else "1 channel"
            what = "not of 3 or 4 channels" if sum(side > 1 for side in self.shape) > 2 else what
            return f"{{target}} is no photograph ({what}: {'x'.join(map(str, self.shape))})"
        if self.match is None:
            return "{target} cannot be compared with photographs: no image files are known (--photos DIR)"
        if not self.is_known:
            like = f"the nearest, {self.match['path']}, correlates at {self.match['correlation']:.2f}"
            return f"{{target}} is of no image file ({like})"
        if self.is_rival:
            return f"{{target}} is less like {self.match['path']} than the picture of another term"
        if not self.match["is_photograph"]:
            return f"{{target}} is {self.match['path']}, no photograph"
        return ""

    def text(self, target: str) -> str:
        """Return what was seen, in words; ``target`` is the name of the side that wants no gradient."""
        why = self.why_other
        what = why or "{target} is " + (self.match or {})["path"]
        parts = [f"{100 * self.share:.0f}% of the loss", what.replace("{target}", target or "the other side")]
        if not self.is_l1:
            kinds = {"robust": "a Huber, Charbonnier or other bent loss, no L1", "signed": "no absolute value is seen"}
            known = kinds.get(self.kind, f"a {self.kind} loss, no L1")
            parts.append(f"{self.kind}, not looked into" if ":" in self.kind else known)
        elif not why:
            known = f"{self.gaussians:,} Gaussians" if self.gaussians else ", ".join(self.parameters)
            parts.append(f"{known or len(self.stepped)} are stepped after it")
        return "; ".join(parts)


class Trace(NamedTuple):
    """The terms that a traced run saw, and its functions of TorchScript by file and name."""

    terms: List[Traced]
    scripted: FrozenSet[Tuple[str, str]]
