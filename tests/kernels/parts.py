"""Stand-ins for the compiler and the driver of the CUDA kernels."""

from __future__ import annotations


class FakeCompiler:
    """Compiles to the options that it was given."""

    version = "12.9"

    def __init__(self):
        self.calls = []

    def target(self, architecture):
        return f"sm_{architecture}"

    def compile(self, source, options, target):
        self.calls.append((tuple(options), target))
        return " ".join([target, *options]).encode(), ""


class FakeDriver:
    """Loads anything, launches nothing, and notes it."""

    architecture, multiprocessors = 90, 132

    def __init__(self):
        self.loads, self.launches, self.captures = [], [], False

    def load(self, binary):
        self.loads.append(binary)
        return binary

    def function(self, module, name):
        return name

    def launch(self, task, *kernels):
        self.launches += [name for name, _, _ in kernels]

    def capturing(self):
        return self.captures
