"""The tables of a comparison, as Markdown that is readable in a terminal."""

from __future__ import annotations

import math
from typing import List, Mapping, Optional, Sequence, Tuple

from legs_loss.lab.experiments.arms import parse_arm
from legs_loss.lab.experiments.statistics import (
    COLUMNS,
    Difference,
    Rows,
    Summary,
    difference,
    summarise_all,
    times_gaussians,
)
from legs_loss.lab.training.metrics import METRICS

Table = Tuple[List[str], List[List[str]]]  # heads, and lines of as many cells

LABELS = [column.label for column in COLUMNS]
MISSING = "–"  # of a row that is older than the metric, or of held-out views where there are none
DECIDES = 500  # iterations: until then 3DGS's schedule adds no Gaussian
SAME_NUMBER = 0.01  # of the Gaussians: the count control's promise


def markdown(heads: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table whose columns are as wide as their widest cell; numbers stand to the right.

    >>> print(markdown(("arm", "PSNR"), (("a", "9.1"), ("legs", "10.2"))))
    | arm  | PSNR |
    | ---- | ---: |
    | a    |  9.1 |
    | legs | 10.2 |
    """
    widths = [max(3, *(len(line[column]) for line in (heads, *lines))) for column in range(len(heads))]
    rule = ["-" * widths[0]] + ["-" * (width - 1) + ":" for width in widths[1:]]

    def line(cells: Sequence[str]) -> str:
        padded = [cells[0].ljust(widths[0])] + [cell.rjust(width) for cell, width in zip(cells[1:], widths[1:])]
        return f"| {' | '.join(padded)} |"

    return "\n".join([line(heads), f"| {' | '.join(rule)} |"] + [line(cells) for cells in lines])


def label(arm: str) -> str:
    """Return the name of an arm in tables, with both names where "C1" is the same training as "legs-l"."""
    name = parse_arm(arm).name
    return name if name == arm else f"{arm} ({name})"


def score_cells(summary: Summary) -> List[str]:
    """Return the cells of :data:`COLUMNS`: mean ± standard deviation where there is one."""
    cells = []
    for column in COLUMNS:
        middle, deviation = summary.mean[column.label], summary.spread[column.label]
        cell = MISSING if math.isnan(middle) else format(middle, column.format)
        has_spread = column.spread and not math.isnan(deviation)
        cells.append(f"{cell} ± {format(deviation, column.format)}" if has_spread else cell)
    return cells


def scores_table(rows: Rows, arms: Sequence[str]) -> Table:
    """Return every arm's scores, mean ± standard deviation over seeds."""
    lines = []
    for arm in arms:
        for summary in summarise_all(rows, [parse_arm(arm).name]):
            lines.append([label(arm), *score_cells(summary), str(summary.seeds)])
    return with_values(["arm", *LABELS, "seeds"], lines)


def with_values(heads: Sequence[str], lines: Sequence[Sequence[str]]) -> Table:
    """Return a table without the columns of optional metrics that no row has."""
    optional = {column.label for column in COLUMNS if column.metric and METRICS[column.metric[1]].available}
    places = [
        place
        for place, head in enumerate(heads)
        if head not in optional or any(line[place] != MISSING for line in lines)
    ]
    return [heads[place] for place in places], [[line[place] for place in places] for line in lines]


# A column of differences, and the split and key of its metric.
DIFFERENCES: Mapping[str, Tuple[str, str]] = {
    column.label: column.metric
    for column in COLUMNS
    if column.metric is not None and column.metric[0] in METRICS[column.metric[1]].differences
}


def differences_table(rows: Rows, arms: Sequence[str], metrics: Mapping[str, Tuple[str, str]] = DIFFERENCES) -> Table:
    """Return each arm's differences from its reference arm in some metrics, with their intervals."""
    lines = []
    for arm in arms:
        name, reference = parse_arm(arm).name, parse_arm(arm).reference
        ratio = None if reference is None else times_gaussians(rows, name, reference)
        if reference is not None and ratio is not None:
            cells = [
                difference_cell(difference(rows, name, reference, split, score), score)
                for split, score in metrics.values()
            ]
            lines.append([f"{label(arm)} − {reference}", *cells, times_cell(ratio)])
    return with_values(["difference", *metrics, "Gaussians"], lines)


def too_short(rows: Rows) -> str:
    """Return why no difference of these rows is given: they were trained too shortly; "" where they were not."""
    fewest = min((row.get("config", {}).get("iterations", DECIDES) for row in rows), default=DECIDES)
    if fewest >= DECIDES:
        return ""
    return f"Too short to decide: {fewest} iterations. Differences are given from {DECIDES} iterations on."


def tables(rows: Rows, arms: Sequence[str]) -> str:
    """Return the scores of the arms, and their differences or why none is given."""
    differences = too_short(rows) or markdown(*differences_table(rows, arms))
    return f"{markdown(*scores_table(rows, arms))}\n\n{differences}"


def difference_cell(value: Optional[Difference], score: str) -> str:
    """Return a difference as a cell: its interval in brackets, and a ? where it is not clear."""
    if value is None:
        return MISSING
    signed = "+" + METRICS[score].format
    text = format(value.mean, signed)
    if not math.isnan(value.low):
        text += f" [{format(value.low, signed)}, {format(value.high, signed)}]"
    return text + ("" if value.clear else " ?")


def times_cell(ratio: float) -> str:
    """Return how many times as many Gaussians as a cell: "same" where the two numbers are as close as promised."""
    return "same" if abs(ratio - 1) <= SAME_NUMBER else f"{ratio:.2f}x"
