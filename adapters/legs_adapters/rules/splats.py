"""Find from the words of the files around a term whether it is about Gaussian splatting."""

from __future__ import annotations

from typing import Dict, List, Set

import libcst as cst

from legs_adapters.code.module import Function, Module
from legs_adapters.code.program import Program
from legs_adapters.code.syntax import code, walk_expressions, words
from legs_adapters.lexicon.words import DRAWS_SPLATS, FIELD, RAYS, SPLATS
from legs_adapters.tensors.backward import Training
from legs_adapters.terms.form import Form

__all__ = ["Splats", "made_of"]


class Splats:
    """Decide which functions of one program are about Gaussian splatting."""

    def __init__(self, program: Program, training: Training) -> None:
        self.program = program
        self.training = training
        self._splats: Dict[str, bool] = {}
        self._rays: Dict[str, bool] = {}

    def about(self, function: Function, form: Form) -> bool:
        """Return whether the term of a function is about splats: by its files, or by the rendering."""
        return self._speaks_around(function) or self._rendered(function.module, function, form)

    def _speaks_around(self, function: Function) -> bool:
        """Return whether the file, or a file that trains through it, mentions Gaussian splatting."""
        seen: Set[Function] = set()
        queue = [function]
        while queue:
            current = queue.pop()
            if current in seen:
                continue
            seen.add(current)
            speaks = self._speaks_of_splats(current.module.path) or self._takes_splats(current.module)
            if speaks and self._runs_with(function.module, current.module):
                return True
            queue.extend(caller for caller, _ in self.training.sites.get(current, []))
        return False

    def _runs_with(self, module: Module, other: Module) -> bool:
        """Return whether a module that calls a name can call this one: it lies near, or mentions this one."""
        stem = module.path.rpartition("/")[2][: -len(".py")]
        return module.path.split("/")[0] in (other.path.split("/")[0], stem + ".py") or stem in other.text

    def _rendered(self, module: Module, function: Function, form: Form) -> bool:
        """Return whether a name in the term or a neighbouring file is about splats, and the file is not about rays."""
        sides = made_of(function, form)
        names = {w for part in sides if isinstance(part, (cst.Name, cst.SimpleString)) for w in words(part.value)}
        if self._speaks_of_rays(module) or "mesh" in words(module.path.rpartition("/")[2]):
            return False
        rendered = any(word.startswith(("render", "raster")) for word in names)
        folder = module.path.rpartition("/")[0]
        near = [path for path in self.program.sources if not folder or path.startswith(folder + "/")]
        if rendered and folder:  # without Gaussians nearby: a mesh is rasterized, too
            top = folder.split("/")[0] + "/"
            near = [path for path in self.program.sources if path.startswith(top)]
            near = [path for path in near if SPLATS.search(self.program.sources[path].text)]
        return any(self._speaks_of_splats(path) for path in near)

    def _takes_splats(self, module: Module) -> bool:
        """Return whether a file imports a Gaussian class, ``GazeGaussianNet``, from one that mentions splats."""
        for node in module.top.flow.imports:
            if isinstance(node, cst.ImportFrom) and "gaussian" in code(node).lower():
                found = self.program.imported_from(module, node)
                if found is not None and self._speaks_of_splats(found.path):
                    return True
        return False

    def _speaks_of_splats(self, path: str) -> bool:
        if path not in self._splats:
            self._splats[path] = DRAWS_SPLATS.search(self.program.sources[path].text) is not None
        return self._splats[path]

    def _speaks_of_rays(self, module: Module) -> bool:
        if module.path not in self._rays:
            self._rays[module.path] = bool(RAYS.search(module.text) or FIELD.search(module.text))
        return self._rays[module.path]


def made_of(function: Function, form: Form) -> List[cst.CSTNode]:
    """Return the parts of both sides, and of what their names were made from."""
    parts: List[cst.CSTNode] = [*walk_expressions(form.first), *walk_expressions(form.second)]
    for part in list(parts):
        if isinstance(part, cst.Name):
            for definition in function.flow.reaching(part):
                if definition.value is not None:
                    parts.extend(walk_expressions(definition.value))
    return parts
