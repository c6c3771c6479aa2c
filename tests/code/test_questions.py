"""Questions that depend on one another: each is asked once outside of a loop, and settles inside of one."""

from __future__ import annotations

from collections import Counter

from legs_adapters.code.module import Module
from legs_adapters.code.questions import Questions
from legs_adapters.code.reaching import Definition, Reaching
from legs_adapters.plan import _large_trees


class Graph:
    """A graph, ``{1: [2, 3]}``, and which nodes each of its nodes reaches, itself included."""

    def __init__(self, edges):
        self.edges = edges
        self.nodes = {name: [name] for name in edges}  # objects with an id of their own
        self.asked = Counter()
        self.questions = Questions()
        self.function = Module("a.py", "x = 1\n").top

    def reached(self, name):
        return self.questions.answer(self.function, self.nodes[name], self.ask, frozenset())

    def ask(self, function, node):
        self.asked[node[0]] += 1
        return frozenset(node).union(*(self.reached(name) for name in self.edges[node[0]]))


def test_each_is_asked_once_without_a_loop():
    graph = Graph({n: [n // 2, n // 3] if n else [] for n in range(200)})
    assert graph.reached(6) == {6, 3, 2, 1, 0}
    assert graph.reached(3) == {3, 1, 0}
    assert set(graph.asked.values()) == {1}


def test_all_of_a_loop_have_the_whole_loop():
    graph = Graph({1: [2], 2: [3, 4], 3: [1], 4: []})
    assert graph.reached(3) == {1, 2, 3, 4}
    asked = graph.asked.copy()
    assert [graph.reached(name) for name in (1, 2, 4)] == [{1, 2, 3, 4}, {1, 2, 3, 4}, {4}]
    assert graph.asked == asked  # remembered, for all of them


def test_a_chain_deeper_than_the_stack_grows_as_its_length():
    def asked(length):
        graph = Graph({n: [n + 1] if n < length else [] for n in range(length + 1)})
        assert max(graph.reached(0)) == length and len(graph.reached(length // 2)) == length - length // 2 + 1
        return sum(graph.asked.values())

    with _large_trees():
        assert asked(4000) <= 2.1 * asked(2000) <= 2.1 * 2 * 2001


def test_joins_have_each_definition_once_in_source_order():
    made = [Definition("x", "assign", None, order=n) for n in range(4)]
    some = made[2].join(made[0])
    both = made[3].join(some).join(made[1])
    assert list(both) == made and list(made[1]) == [made[1]] and not list(Reaching())
    assert some.join(made[0]) is some and made[0].join(some) is some and made[0].join(None) is made[0]
    order = []
    assert [join for join in both.joins(order.__contains__) if order.append(join) is None] == order
    assert order[0] is some and order[-1] is both and len(order) == 3
    met = {made[0]}
    assert {each.order for each in both.new(met)} == {1, 2, 3} and not list(both.new(met))
