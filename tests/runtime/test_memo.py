"""The memo: a map is remembered for its target, and never given for another."""

from __future__ import annotations

import gc
import sys

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from legs_loss.runtime import memo as memo_module
from legs_loss.runtime.memo import _OVERHEAD, WeightMemo, _identity_key
from tests.preloaded import run
from tests.support import legs_environment


class Maker:
    """Counts how often a map had to be made."""

    def __init__(self, pixels=16):
        self.made = 0
        self.pixels = pixels

    def __call__(self):
        self.made += 1
        return torch.full((1, 1, self.pixels), float(self.made))


@pytest.fixture
def by_identity(monkeypatch):
    """Remember by identity, as for a target on a GPU, with tensors of the CPU."""
    monkeypatch.setattr(memo_module, "_key", _identity_key)


class TestByContent:
    def test_the_same_target_is_made_once(self):
        memo, make, target = WeightMemo(), Maker(), torch.rand(3, 4, 4)
        first = memo.recall(target, make)
        assert memo.recall(target, make) is first
        assert memo.recall(target.clone(), make) is first
        assert memo.recall(target.movedim(0, -1).contiguous().movedim(-1, 0), make) is first
        assert make.made == 1

    @settings(max_examples=50, deadline=None)
    @given(st.integers(0, 47), st.floats(1e-6, 1))
    def test_one_changed_value_is_another_target(self, where, change):
        memo, make, target = WeightMemo(), Maker(), torch.zeros(3, 4, 4)
        memo.recall(target, make)
        other = target.clone()
        other.view(-1)[where] += change
        memo.recall(other, make)
        assert make.made == 2

    def test_memory_written_through_numpy_is_noticed(self):
        memo, make, target = WeightMemo(), Maker(), torch.rand(3, 4, 4)
        memo.recall(target, make)
        target.numpy()[0, 0, 0] += 0.5
        memo.recall(target, make)
        assert make.made == 2

    def test_memory_that_is_to_be_read_negated_is_what_is_read(self):
        memo, make, target = WeightMemo(), Maker(), torch.rand(3, 4, 4)
        for same in (target, torch._neg_view(-target), torch._neg_view(target)):
            memo.recall(same, make)
        assert make.made == 2

    def test_shape_and_type_belong_to_it(self):
        memo, make = WeightMemo(), Maker()
        zeros = torch.zeros(3, 4, 4)
        for target in (zeros, zeros.reshape(3, 2, 8), zeros.double()[:, :2], zeros.to(torch.bfloat16)):
            memo.recall(target, make)
        assert make.made == 4


class TestByIdentity:
    def test_the_same_tensor_and_views_of_it_are_known_again(self, by_identity):
        memo, make, stored = WeightMemo(), Maker(), torch.rand(4, 4, 4)
        for _ in range(3):
            memo.recall(stored, make)
        assert make.made == 1
        for _ in range(3):  # `camera.original_image[:3]`, a new tensor each step
            memo.recall(stored[:3], make)
        assert make.made == 2
        with torch.no_grad():
            memo.recall(stored[:3], make)
        assert make.made == 2
        memo.recall(stored[1:], make)
        assert make.made == 3

    def test_a_write_in_place_is_noticed(self, by_identity):
        memo, make, stored = WeightMemo(), Maker(), torch.rand(4, 4, 4)
        memo.recall(stored[:3], make)
        stored.mul_(0.5)
        memo.recall(stored[:3], make)
        assert make.made == 2

    def test_another_tensor_at_the_same_address_is_another_target(self, by_identity):
        memo, make = WeightMemo(), Maker()
        target = torch.rand(64, 64)
        memo.recall(target, make)
        assert len(memo._entries) == 1
        del target
        gc.collect()
        assert (len(memo._entries), memo.bytes) == (0, 0)

    def test_an_inference_tensor_cannot_be_known_again(self, by_identity):
        memo, make = WeightMemo(), Maker()
        with torch.inference_mode():
            target = torch.rand(3, 4, 4)
        memo.recall(target, make)
        memo.recall(target, make)
        assert (make.made, len(memo._entries)) == (2, 0)

    def test_each_stream_computes_for_itself(self, by_identity, monkeypatch):
        """A map that one stream is still writing must not be read by another, which nothing tells to wait."""
        memo, make, target = WeightMemo(), Maker(), torch.rand(3, 4, 4)
        for stream in (7, 8, 7, 8):
            monkeypatch.setattr(memo_module, "_current_stream", lambda device, stream=stream: stream)
            memo.recall(target, make)
        assert make.made == 2

    def test_the_owner_of_a_view_is_its_base(self):
        base = torch.rand(4, 4)
        for target in (base[1:], base):
            assert _identity_key(target)[1] is base


class TestBound:
    def test_it_never_holds_more(self):
        memo = WeightMemo(limit=3 * (64 + _OVERHEAD))
        for i in range(10):
            memo.recall(torch.full((1, 1, 16), float(i)), Maker())
            assert memo.bytes <= memo.limit
        assert len(memo._entries) == 3

    def test_a_used_map_stays_and_the_rest_is_computed(self):
        memo, make = WeightMemo(limit=2 * (64 + _OVERHEAD)), Maker()
        used = [torch.full((1, 1, 16), float(i)) for i in range(2)]
        for target in used + used:
            memo.recall(target, make)
        assert make.made == 2
        for i in range(5):
            memo.recall(torch.full((1, 1, 16), 10.0 + i), make)
        for target in used:
            memo.recall(target, make)
        assert make.made == 7

    def test_a_map_larger_than_the_limit_is_not_kept(self):
        memo = WeightMemo(limit=10)
        memo.recall(torch.rand(3, 4, 4), Maker())
        assert (len(memo._entries), memo.bytes) == (0, 0)

    @pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
    def test_it_takes_what_it_counts(self):
        script = """
import os, torch
from legs_loss.runtime.memo import WeightMemo
from legs_loss.weights import weight_map

def resident():
    return int(open("/proc/self/statm").read().split()[1]) * os.sysconf("SC_PAGESIZE")

torch.set_num_threads(1)
memo = WeightMemo(160 << 20)
for _ in range(5):
    weight_map(torch.rand(3, 400, 600))
before = resident()
while memo.bytes < 150 << 20:
    target = torch.rand(3, 400, 600)
    memo.recall(target, lambda: weight_map(target))
took = resident() - before
print(took / memo.bytes)
raise SystemExit(not 0.9 < took / memo.bytes < 1.5)
"""
        done = run([sys.executable, "-c", script], env=legs_environment())
        assert done.returncode == 0, done.stdout + done.stderr

    def test_the_forms_of_a_target_are_remembered_apart(self):
        memo, target = WeightMemo(), torch.rand(3, 4, 4)
        range_, map_ = torch.zeros(1, 2), torch.ones(1, 4, 4)
        assert memo.recall(target, lambda: range_, True) is range_
        assert memo.recall(target, lambda: map_, False) is map_
        assert memo.recall(target, lambda: torch.zeros(1), True) is range_
        assert memo.bytes == 8 + 64 + 2 * _OVERHEAD
