"""The operators of a response, by name: their stencils as numbers, and their help texts.

To add an operator, add a record. What a backend does not compute is left to torch (``kernels/codes.py``).
"""

from __future__ import annotations

from typing import Dict, NamedTuple, Tuple

from legs_loss.errors import LegsError, did_you_mean

# Rows of weights, an odd number of rows and as many columns. A stencil is even (it equals its own mirror images, as a
# second derivative does) or odd in one direction (a first derivative). Its centre is minus the sum of all others, so
# that its response to a constant image is 0.
Stencil = Tuple[Tuple[float, ...], ...]


class Operator(NamedTuple):
    """An operator: the stencils that an image is correlated with.

    Attributes:
        name: in :class:`~legs_loss.WeightSpec`, legs.toml and on the command line.
        stencils: one, or for a gradient two (across the columns, then down the rows), all of one size.
        help: its description, a few words.
    """

    name: str
    stencils: Tuple[Stencil, ...]
    help: str

    @property
    def reach(self) -> int:
        """Return how many pixels beyond its own a response depends on."""
        return len(self.stencils[0]) // 2


def gradient(across: Stencil) -> Tuple[Stencil, ...]:
    """Return the two stencils of a gradient from that across the columns."""
    return across, tuple(zip(*across))


OPERATORS: Dict[str, Operator] = {
    operator.name: operator
    for operator in (
        Operator("laplacian", (((0, 1, 0), (1, -4, 1), (0, 1, 0)),), "4 neighbours, the paper's"),
        Operator("laplacian8", (((1, 1, 1), (1, -8, 1), (1, 1, 1)),), "8 neighbours"),
        Operator("sobel", gradient(((-1, 0, 1), (-2, 0, 2), (-1, 0, 1))), "gradient, rows weighted 1 2 1"),
        Operator("scharr", gradient(((-3, 0, 3), (-10, 0, 10), (-3, 0, 3))), "gradient, rows weighted 3 10 3"),
        Operator("central", gradient(((0, 0, 0), (-0.5, 0, 0.5), (0, 0, 0))), "gradient, central differences"),
    )
}

NORMS = (1.0, 2.0, float("inf"))


def check_operator(operator: str, p: float) -> None:
    """Check the two settings of a response.

    Raises:
        LegsError: one of them is unknown; the message lists what there is.
    """
    if not isinstance(operator, str) or operator not in OPERATORS:
        names = ", ".join(OPERATORS)
        raise LegsError(f"no operator is named {operator!r}: choose one of {names}" + did_you_mean(operator, OPERATORS))
    # Not `in`: torch.compile with dynamic=True would find none.
    if not isinstance(p, (int, float)) or isinstance(p, bool) or not any(p == norm for norm in NORMS):
        raise LegsError(f"p must be 1, 2 or inf, got {p!r}")
