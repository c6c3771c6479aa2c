"""Build the analyses of one program, each from those before it."""

from __future__ import annotations

from legs_adapters.code.program import Program
from legs_adapters.lexicon.depiction import Meanings
from legs_adapters.lexicon.ways import Ways
from legs_adapters.rules.purpose import Purposes
from legs_adapters.rules.splats import Splats
from legs_adapters.tensors.backward import Training
from legs_adapters.terms.forms import Forms
from legs_adapters.terms.functions import L1Functions
from legs_adapters.terms.kinds.callback import Callbacks


class Analysis:
    """The analyses of one program, made once, each from those before it.

    Args:
        program: the program.

    Attributes:
        program: its files, linked by names.
        training: what its backward passes depend on.
        meanings, ways: what its expressions depict: by their names, too, and by the way they came alone.
        forms: its L1 expressions.
        purposes: the purposes of its backward passes.
        callbacks: the L1 functions that are passed by name.
        splats: which of its functions are about Gaussian splatting.
    """

    def __init__(self, program: Program) -> None:
        self.program = program
        self.training: Training = Training(self.program)
        self.meanings: Meanings = Meanings(self.program, self.training)
        self.ways: Ways = Ways(self.program, self.training)
        self.forms: Forms = Forms(L1Functions(self.program))
        self.purposes: Purposes = Purposes(self.program, self.training)
        self.splats: Splats = Splats(self.program, self.training, self.forms)
        self.callbacks: Callbacks = Callbacks(self.program, self.training, self.forms)
