"""Run a term of a codebase's source text, and what is written in its place, on random tensors.

What is neither a function of the codebase nor an operation becomes a variable of its own, by its text: `image` and
`cam.original_image.cuda()`, the same in both lines. Shapes and types are tried until the original runs.
"""

from __future__ import annotations

import ast
import contextlib
import importlib
import itertools
import sys

import torch

SHAPES = [(3, 12, 9), (2, 3, 12, 9), (12, 9, 3), (2, 12, 9, 3)]
OF_TENSORS = ("shape", "device", "dtype", "T", "mT", "ndim")


@contextlib.contextmanager
def names_of(root, path):
    """Yield what names of a file stand for: its imports, functions, classes, and the functions that it assigns."""
    before, names, tree = set(sys.modules), {}, ast.parse((root / path).read_text())
    methods = {each for node in ast.walk(tree) if isinstance(node, ast.ClassDef) for each in node.body}
    sys.path.insert(0, str(root))
    importlib.invalidate_caches()
    try:
        for kinds in ((ast.Import, ast.ImportFrom), (ast.ClassDef, ast.FunctionDef)):
            for node in ast.walk(tree):
                if isinstance(node, kinds) and node not in methods:
                    with contextlib.suppress(Exception):
                        exec(ast.unparse(node), names)
        for node in ast.walk(tree):
            if isinstance(node, ast.Assign) and isinstance(node.targets[0], (ast.Name, ast.Attribute)):
                with contextlib.suppress(Exception):
                    made = eval(ast.unparse(node.value), names)
                    if callable(made):
                        names.setdefault(ast.unparse(node.targets[0]), made)
        yield names
    finally:
        sys.path.remove(str(root))
        for name in set(sys.modules) - before:
            if str(getattr(sys.modules[name], "__file__", "")).startswith(str(root)):
                del sys.modules[name]


def last_value(root, path, name, line):
    """Return the value of the last assignment to a name above a line; the name where there is none."""
    found = [node for node in ast.walk(ast.parse((root / path).read_text())) if isinstance(node, ast.Assign)]
    values = [node for node in found if node.lineno < line and ast.unparse(node.targets[0]) == name]
    return ast.unparse(max(values, key=lambda node: node.lineno).value) if values else name


class _Leaves(ast.NodeTransformer):
    """Replace what is neither a function nor an operation by variables."""

    def __init__(self, names):
        self.names, self.found, self.bound = names, {}, set()

    def of(self, code):
        return ast.unparse(self.visit(ast.parse(code, mode="eval")))

    def leaf(self, node):
        return ast.Name(self.found.setdefault(ast.unparse(node), f"leaf_{len(self.found)}"), ast.Load())

    def function(self, node):
        """Return a function's node, with a name that it can be read by; None of what is none."""
        text = ast.unparse(node)
        if text in self.names and not text.isidentifier():  # self.l1
            name = "made_" + text.replace(".", "_")
            self.names[name] = self.names[text]
            return ast.Name(name, ast.Load())
        with contextlib.suppress(Exception):
            return node if text != "input" and callable(eval(text, self.names)) else None
        return None

    def visit_Name(self, node):
        return node if node.id in self.bound else self.function(node) or self.leaf(node)

    def visit_Attribute(self, node):
        return self.function(node) or (self.generic_visit(node) if node.attr in OF_TENSORS else self.leaf(node))

    def visit_Subscript(self, node):
        is_key = isinstance(getattr(node.slice, "value", None), str) or ast.unparse(node.slice) == "key"  # of a dict
        return self.leaf(node) if is_key else self.generic_visit(node)

    def visit_Lambda(self, node):
        self.bound |= {argument.arg for argument in node.args.args}
        return ast.Lambda(node.args, self.visit(node.body))

    def visit_Call(self, node):
        is_method = isinstance(node.func, ast.Attribute) and hasattr(torch.Tensor, node.func.attr)
        if is_method and node.func.attr in ("cuda", "to", "cpu"):
            return self.visit(node.func.value)
        function = self.function(node.func)
        if function is None:
            if not is_method:
                return self.leaf(node)
            function = ast.Attribute(self.visit(node.func.value), node.func.attr, ast.Load())
        keywords = [ast.keyword(word.arg, self.visit(word.value)) for word in node.keywords]
        return ast.Call(function, [self.visit(argument) for argument in node.args], keywords)


def _leaves_in(code):
    return {node.id for node in ast.walk(ast.parse(code)) if isinstance(node, ast.Name) and node.id[:5] == "leaf_"}


def _candidates(shape, seed):
    """Yield an image; a choice of pixels; a map; a number; an index."""
    generator = torch.Generator().manual_seed(seed)
    yield torch.rand(shape, generator=generator)
    yield torch.rand(12, 9, generator=generator) > 0.4
    yield torch.rand(1, 12, 9, generator=generator)
    yield 0.7
    yield 1


def _outcome(code, names, values, wanted):
    """Return a term's value and gradients; each pixel of a map has a factor of its own."""
    values = {
        name: value.clone().requires_grad_(name in wanted)
        if torch.is_tensor(value) and value.is_floating_point()
        else value
        for name, value in values.items()
    }
    term = eval(code, {**names, **values})
    if callable(term):  # passed by name
        term = term(values["leaf_0"], values["leaf_1"])
    (term * torch.linspace(1, 2, term.numel()).reshape(term.shape)).sum().backward()
    return [term.detach(), *(values[name].grad for name in sorted(wanted))]


def compare(original, written, prediction, target, names):
    """Run both lines. Return "same", "cannot be run" where the original cannot, or what is wrong."""
    leaves = _Leaves(names)
    wanted = _leaves_in(leaves.of(prediction)) - _leaves_in(leaves.of(target))
    before, after = leaves.of(original), leaves.of(written)
    if before in leaves.found.values() or not wanted:
        return "cannot be run"
    found = sorted(leaves.found.values())
    for shape in SHAPES:
        for chosen in itertools.product(*(_candidates(shape, seed) for seed in range(len(found)))):
            values = dict(zip(found, chosen))
            try:
                expected = _outcome(before, names, values, wanted)
            except Exception:  # other shapes
                continue
            if not all(value is None or value.isfinite().all() for value in expected):  # the mean of no pixel
                continue
            try:
                for one, other in zip(expected, _outcome(after, names, values, wanted)):
                    torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-6)
            except Exception as error:
                return f"{original} -> {written}, {shape}: {error}"
            return "same"
    return "cannot be run"
