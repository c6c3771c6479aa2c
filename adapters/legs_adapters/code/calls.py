"""The calls of a function in a checkout: those by its name, those that are certain, or all possible ones."""

from __future__ import annotations

import re
from typing import Iterator, List, NamedTuple, Optional, Sequence, Tuple

import libcst as cst

from legs_adapters.code.members import Reference, unique
from legs_adapters.code.module import Class, Function, Module
from legs_adapters.code.program import Program
from legs_adapters.code.syntax import attribute_chain, call_name, children, constant, path_of

__all__ = ["BY_NAME", "Calls", "callees", "calls_of", "given_to", "handed", "likely_calls", "sure_calls"]

_METHODS = {"staticmethod", "classmethod"}  # decorators that do not pass the function on
BY_NAME = {"getattr", "attrgetter", "methodcaller", "eval"}  # what looks a name up at run time
_NAMESPACES = {"globals", "locals", "vars"}


class Calls(NamedTuple):
    """The calls of a function, each with its caller; and the place of a further possible call, None without one."""

    known: List[Tuple[Function, cst.Call]]
    lost: Optional[str] = None


class _Mention(NamedTuple):
    """A mention of a name: the expression that ends in it, and the nodes around it, the innermost first."""

    scope: Function
    node: cst.CSTNode
    around: Tuple[cst.CSTNode, ...]

    @property
    def call(self) -> Optional[cst.Call]:
        """The call of the mentioned name."""
        outer = self.around[0]
        return outer if isinstance(outer, cst.Call) and outer.func is self.node else None

    @property
    def where(self) -> str:
        """Its file and line."""
        return _where(self.scope, self.node)


def likely_calls(program: Program, function: Function) -> Iterator[Tuple[Function, cst.Call]]:
    """Yield the calls of a function's name, without those that resolve to another function."""
    for caller, call, known in _named(program, function):
        if not known or function in known:
            yield caller, call


def sure_calls(program: Program, function: Function) -> Iterator[Tuple[Function, cst.Call]]:
    """Yield the calls that resolve to a function, if at most a dozen functions call its name."""
    for caller, call, known in _named(program, function, 12):
        if function in known:
            yield caller, call


def _named(
    program: Program, function: Function, most: Optional[int] = None
) -> Iterator[Tuple[Function, cst.Call, List[object]]]:
    """Yield the calls of a function's name elsewhere, each with its caller and the functions it resolves to."""
    for caller in program.mentioning(function.name, called=True)[:most]:
        for call in _calls_in(caller) if caller is not function else ():
            if call_name(call) == function.name:
                yield caller, call, [r.target for r in program.resolve(caller, call.func) if not r.guess]


def _calls_in(caller: Function) -> Sequence[cst.Call]:
    return caller.flow.calls if caller.module.spend(len(caller.flow.calls)) else ()


def callees(program: Program, function: Function, call: cst.Call) -> List[Function]:
    """Return the functions of the checkout that a call resolves to for certain, without those of instances."""
    found = [ref.target for ref in program.resolve(function, call.func) if ref.kind == "function" and not ref.guess]
    return [target for target in found if isinstance(target, Function)]


def given_to(
    program: Program, function: Function, parameter: str
) -> Iterator[Tuple[Function, Optional[cst.BaseExpression]]]:
    """Yield callers of a function's name, each with its argument for a parameter, None where it is missing."""
    for caller in program.mentioning(function.name, called=True):
        for call in _calls_in(caller) if caller is not function else ():
            if call_name(call) == function.name:
                yield caller, function.given(call, parameter)


def handed(program: Program, function: Function, node: cst.Name) -> List[Reference]:
    """Return the modules that callers pass for a parameter, ``model`` of ``train_epoch(model, loader)``."""
    kinds = {definition.kind for definition in function.flow.reaching(node)}
    if not function.name or kinds - {"store"} != {"parameter"}:
        return []
    return unique(
        reference
        for caller, value in given_to(program, function, node.value)
        if value is not None
        for reference in program.resolve(caller, value)
        if reference.kind == "instance"
    )


def calls_of(program: Program, function: Function) -> Calls:
    """Return the calls of a function.

    No further call is possible where each mention of its name is its definition, an import, or a resolved call. A
    ``forward`` is called by the names of the instances of its class. A function that is passed as a value may be called
    anywhere.
    """
    owner = function.owner if function.runs_by_instance else None
    if owner is None and set(function.decorators) - _METHODS:
        return Calls([], _where(function.parent or function, function.node))
    known: List[Tuple[Function, cst.Call]] = []
    names = [owner.name if owner is not None else function.name]
    for name in names:  # which grow
        said = re.compile(rf"\b{re.escape(name)}\b")
        for module in program.matching(said):
            for mention in _mentions(module, name, said):
                held = _held(program, owner, mention) if owner is not None else []
                names += [holder for holder in held if holder not in names]
                refers = False if held else _refers(program, owner or function, mention)
                if refers and mention.call is not None and not (owner is not None and name == owner.name):
                    known.append((mention.scope, mention.call))
                elif refers is not False:
                    return Calls(known, mention.where)
        unread = {**program.unread, **{path: program.sources[path].text for path in program.unreadable}}
        for path in sorted(unread):
            if said.search(unread[path]):
                return Calls(known, path)
    return Calls(known)


def _refers(program: Program, target: Function | Class, mention: _Mention) -> Optional[bool]:
    """Return whether a mention is of the function, of its class or of an instance; None where it is unknown."""
    node = mention.node
    if isinstance(node, (cst.ImportAlias, cst.SimpleString)):
        return None
    if isinstance(mention.around[0], (cst.AssignTarget, cst.AnnAssign)) and mention.around[0].target is node:
        return False  # what is stored there is mentioned where it is made
    references = program.resolve(mention.scope, node)
    if any(reference.target is target for reference in references):
        return None if any(reference.guess for reference in references) else True
    if references:
        return False
    if mention.call is None and isinstance(node, cst.Name):  # a variable of that name
        kinds = {definition.kind for _, definition in program.lookup(mention.scope, node) or ()}
        return False if kinds and not kinds & {"import", "function", "class"} else None
    in_module = isinstance(target, Function) and target.owner is None
    return False if mention.call is None and in_module else None  # opt.photometric, a weight


def _held(program: Program, owner: Class, mention: _Mention) -> List[str]:
    """Return the names that are assigned an instance: ``self.image_loss = ImageLoss().cuda()``."""
    for outer in mention.around:
        if isinstance(outer, cst.Assign) and any(part is mention.node for part in attribute_chain(outer.value)):
            made = program.resolve(mention.scope, outer.value)
            places = [path_of(target.target) for target in outer.targets]
            if [(r.kind, r.target) for r in made] == [("instance", owner)] and all(places):
                return [place.split(".")[-1] for place in places if place is not None]
    return []


def _mentions(module: Module, name: str, said: re.Pattern[str]) -> Iterator[_Mention]:
    """Yield the mentions of a name in a file, without definitions, imports and keyword arguments."""
    for scope in module.scopes(said.search):
        stack: List[Tuple[cst.CSTNode, Tuple[cst.CSTNode, ...]]] = [(scope.body, ())]
        while stack and module.spend(1):
            node, around = stack.pop()
            if _says(node, around, name):
                yield _Mention(scope, node, around)
            below = [(child, (node, *around)) for child in children(node) if not _is_label(node, child)]
            stack.extend(reversed(below))


def _says(node: cst.CSTNode, around: Tuple[cst.CSTNode, ...], name: str) -> bool:
    if isinstance(node, cst.Name):
        return node.value == name
    if isinstance(node, cst.Attribute):
        return node.attr.value == name
    if isinstance(node, cst.ImportAlias):  # `from losses import photometric as loss`: called by another name
        return node.asname is not None and node.evaluated_name.split(".")[-1] == name
    return isinstance(node, cst.SimpleString) and constant(node) == name and any(map(_looks_up, around[:3]))


def _looks_up(node: cst.CSTNode) -> bool:
    """Return whether a node looks a name up: ``getattr(losses, "photometric")``, ``globals()["photometric"]``."""
    if isinstance(node, cst.Subscript):
        return isinstance(node.value, cst.Call) and call_name(node.value) in _NAMESPACES
    return isinstance(node, cst.Call) and call_name(node) in BY_NAME


def _is_label(node: cst.CSTNode, child: cst.CSTNode) -> bool:
    """Return whether a part of a node is not an expression, or is the body of a function."""
    if isinstance(node, cst.FunctionDef):
        return child is node.name or child is node.body
    if isinstance(node, (cst.ClassDef, cst.Param)):
        return child is node.name
    if isinstance(node, cst.Arg):
        return child is node.keyword
    if isinstance(node, cst.Call):  # super(Loss, self)
        return call_name(node) == "super" and child is not node.func
    return isinstance(node, cst.ImportAlias) or (isinstance(node, cst.Attribute) and child is node.attr)


def _where(scope: Function, node: cst.CSTNode) -> str:
    return f"{scope.module.path}:{scope.place(node).line}"
