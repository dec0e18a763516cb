import pytest
import torch

from wpt_agents.fast import products
from wpt_agents.fast.products import faster_by_convolution
from wpt_agents.model.ops import block_linear, linear, shared_block_linear


def noise(*shape, seed=0, dtype=torch.float32):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def ran(step):
    """The operators that a step called."""
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU]) as profile:
        step()
    return {row.key.removeprefix("aten::") for row in profile.key_averages()}


@pytest.mark.parametrize("bias", [True, False])
@pytest.mark.parametrize("blocks", [1, 4])
def test_many_rows_go_through_a_convolution_which_is_the_matrix_product(blocks, bias, monkeypatch):
    monkeypatch.setattr(products, "AMD_AVX512", True)  # the arithmetic is every CPU's
    monkeypatch.setattr(products, "WORK", 0)
    rows, inputs, outputs = 2 * products.MANY, 12, 8
    wide = noise(rows, inputs + 3).requires_grad_()
    x = wide[:, 3:]  # as a head takes h and z from one tensor
    weight = noise(blocks, inputs // blocks, outputs // blocks, seed=1).requires_grad_()
    bias = noise(outputs, seed=2).requires_grad_() if bias else None
    leaves = [wide, weight] + ([] if bias is None else [bias])
    plain = x @ torch.block_diag(*weight) + (0 if bias is None else bias)
    result = block_linear(x, weight, bias) if blocks > 1 else linear(x, weight[0].t(), bias)
    assert "convolution" in ran(lambda: block_linear(x, weight, bias))
    assert "convolution" in ran(lambda: linear(x, weight.new_ones(5, inputs)))
    torch.testing.assert_close(result, plain, rtol=1e-5, atol=1e-5)
    slope = noise(rows, outputs, seed=3)
    expected = torch.autograd.grad(plain, leaves, slope)
    gradients = torch.autograd.grad(result, leaves, slope)
    torch.testing.assert_close(gradients, expected, rtol=1e-4, atol=1e-4)  # of sums of 512 rows
    in_time = linear(x.unflatten(0, (4, -1)), noise(5, inputs))  # (B, T, inputs)
    torch.testing.assert_close(in_time.flatten(0, 1), x @ noise(5, inputs).t())


def test_which_products_go_through_a_convolution(monkeypatch):
    monkeypatch.setattr(products, "AMD_AVX512", True)
    rows, width = products.MANY, products.WORK // (products.MANY * 64)
    assert faster_by_convolution(noise(rows, 64), width)
    assert faster_by_convolution(noise(4, rows // 4, 64), width)
    assert not faster_by_convolution(noise(rows, 64), width - 1)  # too little work
    assert not faster_by_convolution(noise(rows - 16, 64), 2 * width)
    assert not faster_by_convolution(noise(rows + 1, 64), width)  # 16 images of equally many pixels
    assert not faster_by_convolution(noise(rows, 64, dtype=torch.float64), width)
    assert not faster_by_convolution(noise(rows, 64).to("meta"), width)
    with torch.autocast("cpu", torch.bfloat16):  # whose products are oneDNN's anyway
        assert not faster_by_convolution(noise(rows, 64), width)
    monkeypatch.setattr(products, "AMD_AVX512", False)
    assert not faster_by_convolution(noise(rows, 64), width)


def test_shared_inputs_are_copied_or_their_weights_whichever_are_fewer():
    weight, bias = noise(4, 3 + 2, 5), noise(20)  # 4 blocks of 3 inputs, 2 shared, 5 outputs
    calls = []
    for rows in (4, 5):  # copies of 4 * 4 or 5 * 4 times 2 inputs; the weights are 2 * 20
        private, shared = noise(rows, 12), noise(rows, 2)
        calls.append(
            "cat" in ran(lambda p=private, s=shared: shared_block_linear(p, s, weight, bias))
        )
    assert calls == [True, False]
