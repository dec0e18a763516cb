"""MR.Q's updates equal a plain second implementation, and each loss moves its own networks."""

import numpy as np
import torch
from gymnasium import spaces
from plain import assert_close, batch_of, parameters

from wpt_agents.agents.mrq import MRQKeywords, MRQLearner, MRQPolicy
from wpt_agents.data.transitions import Steps
from wpt_agents.model.mrq import BINS, reward_two_hot

IMAGES = spaces.Box(0, 255, (64, 64, 3), np.uint8)
RATE, SLOW, DECAY, STD, CLIP, Z = 1e-3, 5e-4, 1e-2, 0.4, 0.3, 6
SCALES = 0.7, 1.3


def policy_of(actions=2):
    torch.manual_seed(0)
    space = spaces.Box(-1.0, 1.0, (actions,), np.float32)
    return MRQPolicy(IMAGES, space, channels=2, latent_dim=Z, hidden_dim=8)


def learner_of(policy):
    rates = {"learning_rate": RATE, "encoder_learning_rate": SLOW, "weight_decay": DECAY}
    return MRQLearner(policy, MRQKeywords(std=STD, std_clip=CLIP, grad_clip=0.05, **rates))


def steps_of(n=5, horizon=3, seed=0):
    rng = np.random.default_rng(seed)
    images = rng.integers(0, 256, (n, horizon + 1, 3, 64, 64, 3)).astype(np.uint8)
    action = rng.uniform(-1, 1, (n, horizon, 2)).astype(np.float32)
    reward = rng.normal(size=(n, horizon)).astype(np.float32)
    end, inside = np.zeros((n, horizon), np.float32), np.ones((n, horizon), np.float32)
    end[1, 1] = 1
    inside[1, 2] = 0
    arrays = images[:, 0], action, reward, end, inside, np.ascontiguousarray(images[:, 1:])
    return Steps(*map(torch.from_numpy, arrays))


def copies(module):
    return {k: v.detach().clone() for k, v in module.named_parameters()}


def changed(module, before):
    return {k for k, v in module.named_parameters() if not torch.equal(v, before[k])}


def elu(x):
    return torch.where(x > 0, x, x.exp() - 1)


def normal(x):
    mean, var = x.mean(1, keepdim=True), x.var(1, correction=0, keepdim=True)
    return (x - mean) / (var + 1e-5).sqrt()


def linear(w, name, x):
    return x @ w[f"{name}.weight"].T + w[f"{name}.bias"]


def mlp(w, name, x, activation):
    for i in (0, 1):
        x = activation(normal(linear(w, f"{name}layers.{i}", x)))
    return linear(w, f"{name}last", x)


def state(w, image):
    x = torch.cat([image[:, f].permute(0, 3, 1, 2) for f in range(3)], 1) / 255 - 0.5
    for i, stride in enumerate((2, 2, 2, 1)):
        weights = w[f"state.layers.{i}.weight"], w[f"state.layers.{i}.bias"]
        x = elu(torch.nn.functional.conv2d(x, *weights, stride=stride))
    return elu(normal(linear(w, "state.last", x.reshape(len(x), -1))))


def pair(w, z, action):
    return mlp(w, "pair.", torch.cat([z, elu(linear(w, "action", action))], 1), elu)


def values(w, z_sa):
    bodies = [elu(normal(mlp(w, f"bodies.{k}.", z_sa, elu))) for k in (0, 1)]
    return [linear(w, f"heads.{k}", x)[:, 0] for k, x in enumerate(bodies)]


def act(w, z):
    return mlp(w, "", z, lambda x: x * (x > 0))


class AdamW:
    """Loshchilov and Hutter's algorithm 2, with an optional bound on the gradient's norm."""

    def __init__(self, rate, weights, largest=np.inf):
        self.rate, self.weights, self.largest, self.step = rate, weights, largest, 0
        self.moments = {k: [0.0, 0.0] for k in weights}

    def descend(self, loss):
        self.step += 1
        gradients = torch.autograd.grad(loss, list(self.weights.values()))
        norm = sum((g**2).sum() for g in gradients).sqrt().item()
        for (k, w), g in zip(self.weights.items(), gradients, strict=True):
            g = g * min(self.largest / (norm + 1e-6), 1)
            first = self.moments[k][0] = 0.9 * self.moments[k][0] + 0.1 * g
            second = self.moments[k][1] = 0.999 * self.moments[k][1] + 0.001 * g**2
            first, second = first / (1 - 0.9**self.step), second / (1 - 0.999**self.step)
            w.data = w.data * (1 - self.rate * DECAY) - self.rate * first / (second.sqrt() + 1e-8)


class Reference:
    """The updates of MR.Q, written out."""

    def __init__(self, policy):
        self.f, self.q, self.mu = (
            parameters(m) for m in (policy.encoder, policy.value, policy.actor)
        )
        self.copy()
        self.adams = AdamW(SLOW, self.f), AdamW(RATE, self.q, 0.05), AdamW(RATE, self.mu)

    def copy(self):
        self.f_bar, self.q_bar, self.mu_bar = (
            {k: v.detach().clone() for k, v in w.items()} for w in (self.f, self.q, self.mu)
        )

    def update_encoder(self, batch, ends):
        z, loss = state(self.f, batch.image.float()), 0.0
        for h in range(batch.action.shape[1]):
            out = linear(self.f, "model", pair(self.f, z, batch.action[:, h]))
            end, z, logits = out[:, 0], out[:, 1 : 1 + Z], out[:, 1 + Z :]
            assert logits.shape[1] == BINS
            with torch.no_grad():
                target = state(self.f_bar, batch.next_image[:, h].float())
            cross = -(reward_two_hot(batch.reward[:, h]) * logits.log_softmax(1)).sum(1)
            wrong = ((z - target) ** 2).mean(1) + 0.1 * cross
            wrong = wrong + (0.1 if ends else 0.0) * (end - batch.end[:, h]) ** 2
            loss = loss + (batch.inside[:, h] * wrong).mean()
        self.adams[0].descend(loss)

    def update(self, batch, generator):
        with torch.no_grad():
            then = state(self.f_bar, batch.next_image.float())
            mean = act(self.mu_bar, then).tanh()
            noise = (STD * torch.randn(mean.shape, generator=generator)).clamp(-CLIP, CLIP)
            next_q = torch.minimum(
                *values(self.q_bar, pair(self.f_bar, then, (mean + noise).clamp(-1, 1)))
            )
            y = (batch.reward + batch.discount * SCALES[1] * next_q) / SCALES[0]
            z = state(self.f, batch.image.float())
            z_sa = pair(self.f, z, batch.action)
        errors = [(q - y).abs() for q in values(self.q, z_sa)]
        priority = torch.maximum(*errors).detach().clamp_min(1) ** 0.4
        huber = [torch.where(e < 1, e**2 / 2, e - 0.5) for e in errors]
        self.adams[1].descend(sum((priority * loss).mean() for loss in huber) / 2 / priority.mean())
        u = act(self.mu, z)
        q = sum(values(self.q, pair(self.f, z, u.tanh()))) / 2
        self.adams[2].descend(-q.mean() + 1e-5 * (u**2).mean())


def test_three_updates_equal_a_plain_second_implementation():
    policy = policy_of()
    learner, reference = learner_of(policy), Reference(policy)
    ours, theirs = torch.Generator().manual_seed(5), torch.Generator().manual_seed(5)
    for seed in range(3):
        learner.update_encoder(steps_of(seed=seed), ends=seed > 0)
        reference.update_encoder(steps_of(seed=seed), seed > 0)
        learner.update(batch_of(8, 2, seed), *SCALES, ours)
        reference.update(batch_of(8, 2, seed), theirs)
        if seed == 1:
            learner.copy_targets()
            reference.copy()
    for module, expected in (
        (policy.encoder, reference.f),
        (policy.value, reference.q),
        (policy.actor, reference.mu),
        (policy.target_encoder, reference.f_bar),
        (policy.target_value, reference.q_bar),
        (policy.target_actor, reference.mu_bar),
    ):
        assert_close(module, expected, 1e-5)


def test_each_loss_moves_its_own_networks():
    policy = policy_of()
    learner = learner_of(policy)
    names = ("encoder", "value", "actor", "target_encoder", "target_value", "target_actor")
    modules = {name: getattr(policy, name) for name in names}
    seen = {}
    for loss in ("encoder", "value", "actor"):
        step = getattr(learner, f"{loss}_optimizer").step

        def recorded(step=step, loss=loss):
            before = {n: copies(m) for n, m in modules.items()}
            step()
            seen[loss] = {n for n, m in modules.items() if changed(m, before[n])}

        getattr(learner, f"{loss}_optimizer").step = recorded
    learner.update_encoder(steps_of(), ends=True)
    learner.update(batch_of(8, 2), *SCALES)
    assert seen == {"encoder": {"encoder"}, "value": {"value"}, "actor": {"actor"}}


def test_the_end_is_learned_only_where_some_episode_ends():
    policy = policy_of()
    before = policy.encoder.model.weight[0].clone()
    MRQLearner(policy, MRQKeywords(weight_decay=0.0)).update_encoder(steps_of(), ends=False)
    assert (policy.encoder.model.weight[0] == before).all()
