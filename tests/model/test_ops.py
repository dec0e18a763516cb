import timeit

import pytest
import torch

from wpt_agents.model import ops
from wpt_agents.model.ops import definitions, op


@pytest.fixture
def double(monkeypatch):
    """An operation of its own, which no other test sees, with a twin for several numbers."""
    monkeypatch.setattr(ops, "OPERATIONS", [])
    calls = []

    @op
    def double(x):
        """Twice as much."""
        calls.append("definition")
        return x + x

    @double.faster(when=lambda x: len(x) > 1)
    def double_of_many(x):
        calls.append("twin")
        return 2 * x

    return double, calls


def test_the_twin_is_called_where_its_condition_holds(double):
    function, calls = double
    assert function(torch.ones(1)).tolist() == [2]
    assert function(torch.ones(2)).tolist() == [2, 2]
    assert calls == ["definition", "twin"]


def test_the_first_twin_that_applies_is_called(double):
    function, calls = double
    function.faster(when=lambda x: True)(lambda x: calls.append("second"))
    function(torch.ones(2))
    function(torch.ones(1))
    assert calls == ["twin", "second"]


def test_definitions_switches_all_twins_off_and_back_on(double):
    function, calls = double
    with definitions():
        with definitions():
            function(torch.ones(2))
        function(torch.ones(2))
    function(torch.ones(2))
    with pytest.raises(RuntimeError), definitions():
        raise RuntimeError
    function(torch.ones(2))
    assert calls == ["definition", "definition", "twin", "twin"]


def test_an_operation_reads_like_its_definition(double):
    function, _ = double
    assert function.__name__ == "double" and function.__doc__ == "Twice as much."
    assert ops.OPERATIONS == [function]


def test_an_operation_is_compiled_into_one_graph(monkeypatch):
    monkeypatch.setattr(ops, "OPERATIONS", [])
    triple = op(lambda x: x + x + x)
    triple.faster(when=lambda x: len(x) > 1)(lambda x: 3 * x)
    graphs = []

    def backend(graph, _):
        graphs.append([node.name for node in graph.graph.nodes if node.op == "call_function"])
        return graph.forward

    compiled = torch.compile(triple, backend=backend, fullgraph=True, dynamic=False)
    assert compiled(torch.ones(2)).tolist() == [3, 3]
    with definitions():  # which compiles it again
        assert compiled(torch.ones(2)).tolist() == [3, 3]
    assert compiled(torch.ones(2)).tolist() == [3, 3]
    assert [len(graph) for graph in graphs] == [1, 2]


def test_a_call_costs_microseconds(double, monkeypatch):
    nothing = op(lambda x: x)
    nothing.faster(when=lambda x: False)(lambda x: x)
    seconds = min(timeit.repeat(lambda: nothing(0), number=1000, repeat=5)) / 1000
    assert seconds < 2e-5  # 0.6 microseconds here, alone; the limit is for busy machines
