"""The backward slice: which expressions a ``.backward()`` gets its value from, across functions and keys."""

from __future__ import annotations

import pytest
from legs_adapters.code.syntax import code
from legs_adapters.tensors.backward import Training

from tests.code.support import program, scopes

CASES = {
    "straight": ("loss = term(a)\nloss.backward()", True),
    "a sum": ("loss = 0.8 * term(a) + other(b)\nloss.backward()", True),
    "added to": ("loss = other(b)\nloss += term(a)\nloss.backward()", True),
    "by key": ("losses = {}\nlosses['l1'] = term(a)\nsum(losses.values()).backward()", True),
    "another key": ("losses = {'l1': term(a), 'l2': other(b)}\nlosses['l2'].backward()", False),
    "the key that is read": ("losses = {'l1': term(a), 'l2': other(b)}\nlosses['l1'].backward()", True),
    "in a list": ("losses = []\nlosses.append(term(a))\nsum(losses).backward()", True),
    "only logged": ("seen = term(a)\nlog(seen)\nloss = other(b)\nloss.backward()", False),
    "overwritten": ("loss = term(a)\nloss = other(b)\nloss.backward()", False),
    "detached": ("loss = other(b) * term(a).detach()\nloss.backward()", False),
    "a number": ("loss = other(b) * term(a).item()\nloss.backward()", False),
    "its size": ("loss = other(b) / term(a).shape[0]\nloss.backward()", False),
    "scaled for half precision": ("loss = term(a)\nscaler.scale(loss).backward()", True),
    "torch.autograd.backward": ("loss = term(a)\ntorch.autograd.backward(loss)", True),
    "accelerate's and fabric's": ("loss = term(a)\naccelerator.backward(loss)", True),
}


def trained(text):
    """Return the texts of the calls that a backward pass reaches."""
    made = program(text)
    training = Training(made)
    return {code(call) for where in scopes(made) for call in where.flow.calls if training.includes(call)}


@pytest.mark.parametrize("name", CASES)
def test_what_a_backward_pass_reaches_in_one_function(name):
    text, expected = CASES[name]
    lines = "".join(f"    {line}\n" for line in text.splitlines())
    assert ("term(a)" in trained(f"def step(a, b):\n{lines}")) is expected


def test_a_function_s_return_is_reached_from_its_caller():
    text = "def losses(a):\n    return term(a)\n\ndef step(a):\n    losses(a).backward()\n"
    assert "term(a)" in trained(text)


def test_only_the_returned_element_that_is_used_is_reached():
    text = "def losses(a):\n    return term(a), other(a)\n\ndef step(a):\n    x, y = losses(a)\n    y.backward()\n"
    assert trained(text) >= {"other(a)"} and "term(a)" not in trained(text)


def test_a_parameter_s_backward_reaches_what_callers_give():
    text = "def finish(loss):\n    loss.backward()\n\ndef step(a):\n    finish(term(a))\n"
    assert "term(a)" in trained(text)


def test_lightning_s_training_step_trains_on_what_it_returns():
    text = """
class Model:
    def training_step(self, a, i):
        return term(a)
    def validation_step(self, a, i):
        return other(a)
"""
    assert trained(text) == {"term(a)"}


def test_a_loss_stored_on_the_object_is_reached_from_another_method():
    text = """
class Model:
    def forward(self, a):
        self.loss = term(a)
    def step(self):
        self.loss.backward()
"""
    assert "term(a)" in trained(text)
