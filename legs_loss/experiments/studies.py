"""The built-in studies: their arms, the differences that are reported, and the paper's values.

Of the paper this project knows the text and one table, the training PSNR by curve on Tanks & Temples; its gain over
3DGS; and that C1 is above C5 in SSIM there. Nothing else is quoted as the paper's.
"""

from __future__ import annotations

from types import MappingProxyType
from typing import Mapping, NamedTuple, Optional, Sequence, Tuple

from legs_loss.experiments.arms import needed, parse_arm, parse_arms

__all__ = ["STUDIES", "Study", "these_arms"]


class Study(NamedTuple):
    """A question, and the arms that answer it.

    against: which arm each arm is measured against, where that is not the baseline.
    paper: the paper's training PSNR of an arm, where it gives one.
    paper_says: in words, with its source; empty for arms of the user's own.
    """

    title: str
    arms: Tuple[str, ...]
    paper_says: str
    against: Mapping[str, str] = MappingProxyType({})
    paper: Mapping[str, float] = MappingProxyType({})

    def reference(self, arm: str) -> Optional[str]:
        """Return the arm that this one is measured against, None for the baseline itself."""
        return self.against.get(arm, None if arm == "3dgs" else "3dgs")


STUDIES: Mapping[str, Study] = MappingProxyType(
    {
        "main": Study(
            "The four losses",
            ("3dgs", "eggs", "legs-l", "legs"),
            "The paper reports LEGS 1.2 to 1.7 dB above 3DGS, on training views.",
        ),
        "controls": Study(
            "What the gain is made of",
            (
                "3dgs",
                "legs",
                "legs:scale",
                "legs:shuffled",
                "legs:mean1",
                "legs:threshold",
                "3dgs@legs",
                "legs@3dgs",
                "legs:mean1@3dgs",
            ),
            "The paper has no such controls.",
            {"3dgs@legs": "legs"},
        ),
        "curves": Study(
            "The five curves",
            ("3dgs", "C1", "C2", "C3", "C4", "C5"),
            "The paper's numbers are of Tanks & Temples, training views; which formula is which of C2 to C5 is this "
            "project's identification.",
            paper={"C1": 27.95, "C2": 27.72, "C3": 28.20, "C4": 27.76, "C5": 28.06},
        ),
        "beta": Study(
            "Beta from 0 to 20",
            ("beta=0", "beta=1", "beta=2", "beta=5", "beta=10", "beta=15", "beta=20"),
            "The paper's beta is 10; the numbers of its own sweep are not known here.",
        ),
        "codebase": Study(
            "By a codebase's own script (--upstream)",
            ("3dgs", "eggs", "legs-l", "legs", "legs:mean1", "3dgs@legs"),
            "The paper reports LEGS 1.2 to 1.7 dB above the codebase it is added to, on training views.",
            {"3dgs@legs": "legs"},
        ),
    }
)


def these_arms(names: Sequence[str]) -> Study:
    """Return the study of arms that a user names, with the baseline and the arms whose numbers they take.

    3DGS with an arm's number of Gaussians is measured against that arm.

    >>> these_arms(["C4", "3dgs@legs"]).arms
    ('3dgs', 'legs', 'C4', '3dgs@legs')
    """
    own = dict(zip((arm.name for arm in map(parse_arm, names)), names))
    arms = sorted(needed(parse_arms(["3dgs", *names])), key=lambda arm: arm.name != "3dgs")  # else as they were
    against = {arm.name: arm.at for arm in arms if arm.spec.beta == 0 and arm.at not in (None, "3dgs")}
    return Study("These arms", tuple(own.get(arm.name, arm.name) for arm in arms), "", against)
