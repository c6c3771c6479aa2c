"""Name resolution: which function, class or library a name in one file refers to."""

from __future__ import annotations

import pytest
from legs_adapters.code.module import Class, Function

from tests.code.support import function, program

LOSSES = "def l1(a, b):\n    return abs(a - b)\n\ndef l2(a, b):\n    return (a - b) ** 2\n"
STEP = "def step():\n    {call}\n"


def resolved(files, place="step"):
    """Return the objects that the last call of a function refers to, each as (kind, name)."""
    made = program(files)
    where = function(made, place)
    found = made.resolve(where, where.flow.calls[-1].func)
    return [(r.kind, r.target.name if isinstance(r.target, (Function, Class)) else str(r.target)) for r in found]


IMPORTS = {
    "from a module": ("from utils.losses import l1\n", "l1(a, b)"),
    "under another name": ("from utils.losses import l1 as loss\n", "loss(a, b)"),
    "a module": ("import utils.losses\n", "utils.losses.l1(a, b)"),
    "a module under another name": ("import utils.losses as ul\n", "ul.l1(a, b)"),
    "everything": ("from utils.losses import *\n", "l1(a, b)"),
    "in the function": ("", "from utils.losses import l1; l1(a, b)"),
    "a name of a name": ("from utils.losses import l1\nloss = l1\n", "loss(a, b)"),
    "partial": ("from functools import partial\nfrom utils.losses import l1\nloss = partial(l1)\n", "loss(a, b)"),
    "a dictionary's value": ("from utils.losses import l1\nkinds = {'l1': l1}\n", "kinds['l1'](a, b)"),
}


@pytest.mark.parametrize("form", IMPORTS)
def test_an_import_leads_to_the_function(form):
    head, text = IMPORTS[form]
    files = {"utils/__init__.py": "", "utils/losses.py": LOSSES, "main.py": head + STEP.format(call=text)}
    assert resolved(files) == [("function", "l1")]


def test_a_relative_import_leads_to_the_neighbour():
    main = "from .losses import l1\n" + STEP.format(call="l1(a, b)")
    assert resolved({"pkg/__init__.py": "", "pkg/losses.py": LOSSES, "pkg/train.py": main}) == [("function", "l1")]


def test_what_the_checkout_lacks_is_external_by_its_whole_name():
    files = "import torch.nn.functional as F\n" + STEP.format(call="F.l1_loss(a, b)")
    assert resolved(files) == [("external", "torch.nn.functional.l1_loss")]


def test_a_name_that_nothing_defines_is_nothing():
    assert resolved(STEP.format(call="unheard_of(a, b)")) == []


def test_a_method_is_its_class_own_or_its_base():
    files = """
class Base:
    def loss(self, a, b): return a
class Model(Base):
    def step(self): self.loss(1, 2)
"""
    assert resolved(files) == [("function", "loss")]


def test_an_instance_of_a_class_is_called_by_its_forward():
    files = "class L1:\n    def forward(self, a, b): return a\n\ndef step():\n    loss = L1().cuda()\n    loss(1, 2)\n"
    assert resolved(files)[0] in {("instance", "L1"), ("function", "forward")}


def test_a_function_may_be_either_of_two():
    head = "from utils.losses import l1, l2\n"
    files = {
        "utils/__init__.py": "",
        "utils/losses.py": LOSSES,
        "main.py": head + "def step(a):\n    f = l1\n    if a:\n        f = l2\n    f(1, 2)\n",
    }
    assert sorted(resolved(files)) == [("function", "l1"), ("function", "l2")]


METRICS = """
class Metric:
    def make(self): pass

class Plain(Metric):
    def make(self): return PlainLoss()

class PlainLoss:
    def total(self, a, b): return a

class Other:
    def total(self, a, b): return b
"""


def test_a_method_of_an_object_of_unknown_class_is_unknown():
    assert resolved(METRICS + "def step(metric):\n    metric.total(1, 2)\n") == []
    assert resolved(METRICS + "def step(settings):\n    settings.metric().total(1, 2)\n") == []


def test_a_declared_class_stands_for_those_that_derive_from_it():
    step = """
class Trainer:
    def __init__(self, metric: Metric):
        self.metric = metric.make()
    def step(self): self.metric.total(1, 2)
"""
    files = {"metrics.py": METRICS, "train.py": "from metrics import Metric\n" + step}
    assert resolved(files) == [("function", "total")]
    made = program(files)
    where = function(made, "step")
    [reference] = made.resolve(where, where.flow.calls[-1].func)
    assert reference.target.owner.name == "PlainLoss"  # Other.total has the same name
