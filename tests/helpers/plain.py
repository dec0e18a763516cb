"""A plain second implementation of what the model-free learners share: layers and Adam."""

import numpy as np
import torch
import torch.nn.functional as F

from wpt_agents.data.transitions import Transitions


def parameters(module):
    """{name: a copy of the parameter}, with gradients."""
    return {k: v.detach().clone().requires_grad_() for k, v in module.named_parameters()}


def encode(w, image, strides, centre):
    """The convolutions over stacked frames: w of a FrameEncoder."""
    x = torch.cat([image[:, f].permute(0, 3, 1, 2) for f in range(3)], 1) / 255 - centre
    for i, stride in enumerate(strides):
        x = F.conv2d(x, w[f"layers.{i}.weight"], w[f"layers.{i}.bias"], stride=stride)
        x = x * (x > 0)  # clamp_min would let a gradient through at exactly 0, which units reach
    return x.reshape(len(x), -1)


def trunk(w, embed):
    """z = tanh(norm(W e + b)): w of any network with a `trunk`."""
    x = embed @ w["trunk.0.weight"].T + w["trunk.0.bias"]
    mean, var = x.mean(1, keepdim=True), x.var(1, correction=0, keepdim=True)
    return ((x - mean) / (var + 1e-5).sqrt() * w["trunk.1.weight"] + w["trunk.1.bias"]).tanh()


def two_layers(w, name, x):
    """An MLP of two hidden layers: w of `mlp` under `name`."""
    for i in (0, 2):
        x = x @ w[f"{name}.{i}.weight"].T + w[f"{name}.{i}.bias"]
        x = x * (x > 0)
    return x @ w[f"{name}.4.weight"].T + w[f"{name}.4.bias"]


class Adam:
    """Kingma and Ba's algorithm 1, on dictionaries of parameters."""

    def __init__(self, rate, *groups):
        self.rate, self.groups, self.step = rate, groups, 0
        self.moments = [{k: [0.0, 0.0] for k in group} for group in groups]

    def descend(self, loss):
        self.step += 1
        flat = [v for group in self.groups for v in group.values()]
        gradients = iter(torch.autograd.grad(loss, flat))
        for group, moments in zip(self.groups, self.moments, strict=True):
            for k, w in group.items():
                g = next(gradients)
                first, second = moments[k]
                first = moments[k][0] = 0.9 * first + 0.1 * g
                second = moments[k][1] = 0.999 * second + 0.001 * g**2
                first, second = first / (1 - 0.9**self.step), second / (1 - 0.999**self.step)
                w.data -= self.rate * first / (second.sqrt() + 1e-8)


def batch_of(n, action_dim, seed=0):
    """Random transitions."""
    rng = np.random.default_rng(seed)
    image, other = rng.integers(0, 256, (2, n, 3, 64, 64, 3)).astype(np.uint8)
    action = rng.uniform(-1, 1, (n, action_dim)).astype(np.float32)
    reward, discount = rng.random((2, n)).astype(np.float32)
    return Transitions(*(torch.from_numpy(x) for x in (image, action, reward, discount, other)))


def assert_close(module, expected, atol=2e-6):
    """That a module's parameters are those of a dictionary."""
    for name, w in module.named_parameters():
        torch.testing.assert_close(w.detach(), expected[name].detach(), atol=atol, rtol=1e-4)
