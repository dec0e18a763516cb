"""Every faster twin returns what the definition returns, values and gradients.

`EXAMPLES` has inputs on which each twin's condition holds. A twin without an example fails.
"""

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, field

import pytest
import torch
from debug_agent import agent
from torch.utils._pytree import tree_leaves

import wpt_agents.fast
from wpt_agents.fast import compiled, pieces, products
from wpt_agents.model.images import Decoder
from wpt_agents.model.layers import Head
from wpt_agents.model.ops import OPERATIONS, definitions
from wpt_agents.model.rssm import RSSM, Latent
from wpt_agents.model.sizes import SIZES

DEBUG = SIZES["debug"]
TWINS = {twin.__name__: (op, when, twin) for op in OPERATIONS for when, twin in op.twins}


@dataclass
class Example:
    """How a twin is called.

    :param arguments: makes the arguments, with a new generator at each call
    :param leaves: whose gradients are compared
    """

    arguments: Callable[[], tuple]
    leaves: list[torch.Tensor] = field(default_factory=list)
    context: Callable = nullcontext
    tolerance: float = 1e-4


def noise(*shape, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed)).requires_grad_()


def of_tensors(*tensors, **options):
    return Example(lambda: tensors, [x for x in tensors if x.requires_grad], **options)


def of_modules(arguments, *modules, **options):
    return Example(arguments, [p for m in modules for p in m.parameters()], **options)


def generator():
    return torch.Generator().manual_seed(5)


def large_product(patch, *tensors):
    patch.setattr(products, "AMD_AVX512", True)  # the arithmetic is every CPU's
    patch.setattr(products, "WORK", 0)
    return of_tensors(*tensors)


def latent(n, size=DEBUG):
    code = noise(n, size.stoch, size.classes, seed=2)
    return Latent(noise(n, size.deter, seed=1), code.detach().softmax(-1).requires_grad_())


def sequence(patch):
    torch.manual_seed(0)
    rssm, state = RSSM(DEBUG, 3, 10), latent(4)
    is_first = torch.zeros(4, 5, dtype=torch.bool)
    is_first[:3, 0] = is_first[1, 3] = True
    halves = noise(4, 5, DEBUG.hidden), noise(4, 5, DEBUG.hidden, seed=4)
    parts = rssm.gru, rssm.post_in, rssm.post_out
    # the action's embedding, the prior and the bias that is in `embed_half` are outside
    outside = {id(p) for p in (*rssm.gru.from_action.parameters(), rssm.post_in.bias)}
    weights = [p for part in parts for p in part.parameters() if id(p) not in outside]
    return Example(
        lambda: (rssm, *halves, is_first, state, generator()), [*halves, *state, *weights]
    )


def pieces_of(size):
    def example(patch):
        patch.setattr(pieces, "PIECE", 3 * size)
        head = Head(DEBUG, 2, 5)
        return of_modules(lambda: (head._rows, size, noise(7, 128).detach()), head)

    return example


def steps(patch):
    patch.setattr(pieces, "PIECE", 1)
    head = Head(DEBUG, 2, 5)
    states = Latent(noise(3, 4, DEBUG.deter), noise(3, 4, 8, 8, seed=1))
    return Example(lambda: (head, states), [*states, *head.parameters()])


def decoded(patch):
    torch.manual_seed(0)
    decoder, state = Decoder(DEBUG), latent(3)
    image = torch.randint(256, (3, 64, 64, 3), dtype=torch.uint8)
    return Example(lambda: (decoder, state, image), [*state, *decoder.parameters()])


def shifts(patch):
    image = torch.randint(256, (5, 3, 8, 9, 3), dtype=torch.uint8)
    shift = torch.tensor([[0, 0], [3, -3], [-3, 3], [2, 1], [-1, -2]])
    return Example(lambda: (image, shift, 3), tolerance=0)


def acting(patch):
    policy, n = agent().policy, 3
    image = torch.randint(256, (n, 64, 64, 3), dtype=torch.uint8)
    is_first, action = torch.tensor([True, False, False]), noise(n, 4).detach()
    state = Latent(*(x.detach() for x in latent(n)))
    arguments = policy, image, state, action, is_first
    return Example(lambda: (*arguments, generator()), context=torch.inference_mode)


def compiled_step(patch):
    policy = agent().policy
    compiled.compile_loops(policy, "eager")
    rssm, state = policy.world_model.rssm, latent(4)
    halves = noise(4, DEBUG.hidden), noise(4, DEBUG.hidden, seed=1)
    is_first = torch.tensor([True, False, False, True])
    arguments = rssm, state, *halves, is_first
    return Example(
        lambda: (*arguments, generator()), [*state, *halves, *rssm.post_out.parameters()]
    )


def compiled_dream(patch):
    policy = agent().policy
    compiled.compile_loops(policy, "eager")
    start = latent(2)
    leaves = [*start, *policy.actor.parameters()]
    return Example(lambda: (policy, start, 3, generator()), leaves)


KERNEL = noise(3, 2, 6, 6, seed=1)
BLOCKS = noise(4, 3, 2, seed=1)
EXAMPLES = {
    "linear_by_convolution": lambda patch: large_product(
        patch, noise(2, 256, 12), noise(8, 12, seed=1), noise(8, seed=2)
    ),
    "block_linear_by_convolution": lambda patch: large_product(
        patch, noise(512, 12), BLOCKS, noise(8, seed=2)
    ),
    "block_linear_by_bmm": lambda _: of_tensors(noise(5, 12), BLOCKS, noise(8, seed=2)),
    "shared_block_linear_by_two_products": lambda _: of_tensors(
        noise(5, 8), noise(5, 1, seed=3), BLOCKS, noise(8, seed=2)
    ),
    "down_conv_by_patches": lambda _: of_tensors(
        noise(1, 3, 7, 7), noise(5, 3, 4, 4, seed=1), noise(5, seed=2), context=torch.no_grad
    ),
    "up_conv_of_a_pixel": lambda _: of_tensors(noise(4, 3, 1, 1), KERNEL, noise(2, seed=2)),
    "up_conv_forward_by_phases": lambda _: of_tensors(noise(4, 3, 5, 5), KERNEL, noise(2, seed=2)),
    "up_conv_by_phases": lambda _: of_tensors(
        *(noise(4, 3, 5, 5), KERNEL, noise(2, seed=2)),
        context=lambda: torch.autocast("cpu", torch.bfloat16),
        tolerance=0.05,
    ),
    "reconstruction_error_by_parity": decoded,
    "over_rows_in_pieces": pieces_of(64),
    "over_steps_one_by_one": steps,
    "scan": sequence,
    "shifted_by_cuts": shifts,
    "acting_step_with_copies": acting,
    "compiled_filter_step": compiled_step,
    "compiled_dream": compiled_dream,
}


def outcome(op, example):
    """The tensors that an operation returns, and the gradients of a weighted sum of them."""
    arguments = example.arguments()
    with example.context():
        outputs = [x for x in tree_leaves(op(*arguments)) if x is not None]
    if not example.leaves or not any(x.requires_grad for x in outputs):
        return outputs, []
    total = sum((x * noise(*x.shape, seed=9).detach()).sum() for x in outputs)
    return outputs, list(torch.autograd.grad(total, example.leaves, allow_unused=True))


def assert_close(actual, expected, tolerance):
    assert len(actual) == len(expected)
    for ours, defined in zip(actual, expected, strict=True):
        if defined is None:
            assert ours is None
            continue
        largest = defined.abs().max().item() + 1e-6
        torch.testing.assert_close(
            ours.float(), defined.float(), rtol=tolerance, atol=tolerance * largest
        )


def test_every_twin_has_an_example():
    assert EXAMPLES.keys() == TWINS.keys()


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor")  # which torch.compile reads
@pytest.mark.parametrize("name", TWINS)
def test_the_twin_is_the_definition(name, monkeypatch):
    op, _, twin = TWINS[name]
    example = EXAMPLES[name](monkeypatch)
    with example.context():
        used = next(t for when, t in op.twins if when(*example.arguments()))
    assert used is twin
    outputs, gradients = outcome(op, example)
    with definitions():
        defined_outputs, defined_gradients = outcome(op, example)
    assert_close(outputs, defined_outputs, example.tolerance)
    assert_close(gradients, defined_gradients, example.tolerance)
    assert len(gradients) == (0 if example.context in NO_GRADIENT else len(example.leaves))


NO_GRADIENT = (torch.no_grad, torch.inference_mode)


def test_every_module_of_the_folder_registers_its_twins():
    assert {twin.__module__ for _, _, twin in TWINS.values()} == {
        f"{wpt_agents.fast.__name__}.{name}"
        for name in ("acting", "compiled", "convolutions", "pieces", "products", "scan", "shifts")
    }


def test_a_twin_that_errs_is_noticed(monkeypatch):
    op, when, _ = TWINS["block_linear_by_bmm"]
    monkeypatch.setattr(op, "twins", [(when, lambda x, w, b: 1.001 * op.definition(x, w, b))])
    example = EXAMPLES["block_linear_by_bmm"](monkeypatch)
    outputs, _ = outcome(op, example)
    with definitions():
        expected, _ = outcome(op, example)
    with pytest.raises(AssertionError):
        assert_close(outputs, expected, 1e-4)
