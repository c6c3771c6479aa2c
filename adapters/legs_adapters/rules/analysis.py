"""Build the analyses of one program, each from those before it."""

from __future__ import annotations

from typing import Iterable, Mapping, Optional

from legs_adapters.code.program import Program
from legs_adapters.code.sources import Source
from legs_adapters.lexicon.depiction import Meanings
from legs_adapters.lexicon.views import Views
from legs_adapters.rules.purpose import Purposes
from legs_adapters.rules.splats import Splats
from legs_adapters.tensors.backward import Training
from legs_adapters.tensors.modules import TORCH
from legs_adapters.terms.forms import Forms
from legs_adapters.terms.functions import L1Functions
from legs_adapters.terms.kinds.callback import Callbacks
from legs_adapters.terms.prospects import Prospects

__all__ = ["Analysis"]


class Analysis:
    """The analyses of one program, made once, each from those before it.

    Attributes:
        program: its files, linked by names.
        prospects: which text can lead to an L1.
        training: what its backward passes depend on.
        meanings: what its expressions depict.
        views: whose images its targets are.
        forms: its L1 expressions.
        purposes: what its backward passes are for.
        splats: which of its functions are about Gaussian splatting.
        callbacks: the L1 functions that are passed by name.
    """

    def __init__(self, sources: Iterable[Source], unread: Optional[Mapping[str, str]] = None) -> None:
        self.program = Program(sources, unread, TORCH)
        self.prospects = Prospects(source.text for source in self.program.sources.values())
        self.training = Training(self.program, self.prospects.of)
        self.meanings = Meanings(self.program, self.training)
        self.views = Views(self.program)
        self.forms = Forms(L1Functions(self.program, self.prospects))
        self.purposes = Purposes(self.program, self.training)
        self.splats = Splats(self.program, self.training)
        self.callbacks = Callbacks(self.program, self.training, self.forms)
