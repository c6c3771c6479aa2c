"""Find from the words of the files around a term whether it is about Gaussian splatting."""

from __future__ import annotations

import ast
import re

from legs_adapters.code.limits import remembered
from legs_adapters.code.module import Function, Module
from legs_adapters.code.program import Program
from legs_adapters.code.syntax import code
from legs_adapters.lexicon.words import DRAWS_SPLATS, RAYS, SPLATS
from legs_adapters.tensors.backward import Training
from legs_adapters.terms.forms import Forms

_COMMENT = re.compile("#.*")  # proves nothing


class Splats:
    """Decide which functions of one program are about Gaussian splatting."""

    def __init__(self, program: Program, training: Training, forms: Forms) -> None:
        self.program = program
        self.training = training
        self.forms = forms

    @remembered
    def is_about(self, function: Function) -> bool:
        """Return whether the file, one that trains through it, or a neighbour mentions Gaussian splatting."""
        module, above = function.module, [function]
        for current in above:  # which grows
            if self._speaks(current.module.path, DRAWS_SPLATS) or self._takes_splats(current.module):
                return True
            above += [caller for caller, _ in self.training.sites.get(current, []) if caller not in above]
        sides = [code(side) for form in self.forms.in_function(function) for side in (form.first, form.second)]
        is_rendered = "render" in " ".join(sides)  # what is in the whole of a folder renders it
        folder = module.path[: module.path.find("/") + 1 if is_rendered else module.path.rfind("/") + 1]
        near = [path for path in self.program.sources if path.startswith(folder)]
        return not RAYS.search(module.text) and any(self._speaks(path, SPLATS) for path in near)

    def _takes_splats(self, module: Module) -> bool:
        """Return whether a file imports a Gaussian class, ``GazeGaussianNet``, from one that mentions splats."""
        taken = [node for node in module.top.flow.imports if "gaussian" in code(node).lower()]
        found = [self.program.imported_from(module, node) for node in taken if isinstance(node, ast.ImportFrom)]
        return any(made is not None and self._speaks(made.path, DRAWS_SPLATS) for made in found)

    @remembered
    def _speaks(self, path: str, words: re.Pattern[str]) -> bool:
        return words.search(_COMMENT.sub("", self.program.sources[path].text)) is not None
