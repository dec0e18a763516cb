"""The authors' own weights: what their code computes from them, and what files are refused.

The fixtures are a model of random weights in the authors' format and what their code computes from
it (zhaoyi11/ncrl, commit a7422f6): 4 groups of 6 classes, action width 21, of which 6 are used.
"""

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from debug_agent import SETTINGS, agent, recorded, same, weights
from gymnasium import spaces
from toy_env import DotEnv

from wpt_agents.agents.wpt import WPT
from wpt_agents.fast.acting import FastStep
from wpt_agents.fast.acting_networks import FastActor
from wpt_agents.files.official import PARTS
from wpt_agents.model.images import to_unit
from wpt_agents.model.ops import definitions
from wpt_agents.model.rssm import Latent
from wpt_agents.model.sizes import Size
from wpt_agents.model.world_model import squared_error

FIXTURES = Path(__file__).parents[1] / "fixtures"
TINY, PRETRAINED = FIXTURES / "official_tiny.pt", FIXTURES / "official_tiny_pretrained.pt"
LEARNING = {k: v for k, v in SETTINGS.items() if k not in ("size", "max_action_dim")}


def tiny(path=TINY, **changes):
    return WPT.from_official(path, stoch=4, **LEARNING | changes)


def read(path):
    return torch.load(path, weights_only=True)


def flat(content, name=""):
    """The tensors of nested dictionaries, by their joined names."""
    if isinstance(content, torch.Tensor):
        return {name: content}
    return {k: v for key, part in content.items() for k, v in flat(part, f"{name}/{key}").items()}


# --------------------------------------------------------------------- what their code computes


@pytest.fixture(scope="module")
def expected():
    arrays = np.load(FIXTURES / "official_tiny_outputs.npz")
    return {name: torch.from_numpy(array) for name, array in arrays.items()}


def computed(policy, arrays):
    """Every output of the fixture, as `WPT` computes it when it learns."""
    model, state = policy.world_model, Latent(arrays["deter"], arrays["stoch"])
    policy.set_action_space(spaces.Box(-1.0, 1.0, (6,)))
    embed, start = model.encoder(arrays["image"]), torch.zeros(5, 1, dtype=torch.bool)
    post, post_logits, prior_logits = model.rssm.observe(
        embed[:, None], arrays["action"][:, None], start, state
    )
    actor = policy.actor.dist(state.feat, policy.action_mask)
    return {
        "embed": embed,
        "next_deter": post.deter[:, 0],
        "prior_log_probs": prior_logits[:, 0],
        "post_log_probs": post_logits[:, 0],
        "reconstruction": model.decoder(*state),
        "reward_logits": model.reward_head(state.feat),
        "critic_logits": policy.critic(state.feat),
        "target_critic_logits": policy.target_critic(state.feat),
        "actor_mean": actor.mean * policy.action_mask,
        "actor_std": actor.std,
    }


def assert_all_close(outputs, expected):
    inputs = {"image", "deter", "stoch", "action"}
    assert outputs.keys() == expected.keys() - inputs
    for name, value in outputs.items():
        torch.testing.assert_close(value.detach(), expected[name], rtol=0, atol=1e-5, msg=name)


def test_the_definitions_compute_what_the_authors_code_computes(expected):
    with definitions():
        assert_all_close(computed(tiny().policy, expected), expected)


def test_the_fast_paths_of_learning_compute_what_the_authors_code_computes(expected):
    assert_all_close(computed(tiny().policy, expected), expected)


def test_the_reconstruction_error_is_that_of_the_authors_images(expected):
    latent = Latent(expected["deter"][:, None], expected["stoch"][:, None])
    error = tiny().policy.world_model.reconstruction_error(latent, expected["image"][:, None])
    truth = squared_error(to_unit(expected["image"]), expected["reconstruction"])
    torch.testing.assert_close(error[:, 0], truth, rtol=1e-5, atol=0)


@torch.no_grad()
def test_imagination_steps_as_the_authors_code(expected):
    state = Latent(expected["deter"], expected["stoch"])
    rssm = tiny().policy.world_model.rssm
    states, _ = rssm.imagine(state, lambda *_: expected["action"], 1)
    torch.testing.assert_close(states.deter[:, 1], expected["next_deter"], rtol=0, atol=1e-5)


@torch.no_grad()
def test_the_fast_path_of_acting_computes_what_the_authors_code_computes(expected):
    policy, state = tiny().policy, Latent(expected["deter"], expected["stoch"])
    first = torch.zeros(5, dtype=torch.bool)
    step = FastStep(policy)
    post, _ = step(expected["image"], state, expected["action"], first, None, sample=False)
    torch.testing.assert_close(post.deter, expected["next_deter"], rtol=0, atol=1e-5)
    assert torch.equal(post.stoch.argmax(-1), expected["post_log_probs"].argmax(-1))
    mean, std = FastActor(policy.actor, policy.size.classes)(state).chunk(2, -1)
    torch.testing.assert_close(mean[:, :6].tanh(), expected["actor_mean"][:, :6], rtol=0, atol=1e-5)
    std = 0.9 * torch.sigmoid(std + 2) + 0.1
    torch.testing.assert_close(std, expected["actor_std"], rtol=0, atol=1e-5)


# ------------------------------------------------------------------------ there and back again


@pytest.mark.parametrize("path", [TINY, PRETRAINED])
def test_saving_loading_and_exporting_give_back_every_array(path, tmp_path):
    tiny(path).save(tmp_path / "model.zip")
    WPT.load(tmp_path / "model.zip").save_official(tmp_path / "again.pt")
    before, after = flat(read(path)), flat(read(tmp_path / "again.pt"))
    assert before.keys() <= after.keys()
    assert all(torch.equal(before[name], after[name]) for name in before)


def test_an_export_has_the_names_of_the_authors_file_in_their_order(tmp_path):
    tiny(PRETRAINED).save_official(tmp_path / "again.pt")
    assert list(flat(read(tmp_path / "again.pt"))) == list(flat(read(TINY)))


def test_a_model_of_ours_in_their_layout_goes_there_and_back(tmp_path):
    size = Size(64, 32, 4, 8, 4, 32, gates="across", norm_eps=1e-5)
    model = agent(size=size, max_action_dim=21)
    model.save_official(tmp_path / "ours.pt")
    back = WPT.from_official(tmp_path / "ours.pt", stoch=4, **LEARNING)
    assert back.max_action_dim == 21
    both = weights(model, "world_model", "actor", "critic", "target_critic")
    assert same(both, weights(back, "world_model", "actor", "critic", "target_critic"))


def test_a_model_whose_gates_lie_otherwise_is_not_exported(tmp_path):
    with pytest.raises(
        ValueError, match=r"needs a model whose size has gates='across' and norm_eps=1e-05"
    ):
        agent().save_official(tmp_path / "ours.pt")
    assert not list(tmp_path.iterdir())


def test_heads_that_the_file_does_not_hold_are_drawn_by_the_seed():
    one, again, other = (weights(tiny(PRETRAINED, seed=seed)) for seed in (0, 0, 1))
    assert same(one, again)
    drawn = {name for name in one if not torch.equal(one[name], other[name])}
    parts = {name.removeprefix("world_model.").split(".")[0] for name in drawn}
    assert parts == {"reward_head", "actor", "critic", "target_critic", "prior_actor"}
    weight = one["actor.from_stoch.weight"]  # 512 units, as the authors' heads
    assert len(weight) == 512 and 0 < weight.abs().max() <= weight.shape[1] ** -0.5


@pytest.mark.parametrize("path", [TINY, PRETRAINED])
def test_fine_tuning_goes_on_from_their_weights(path, tmp_path):
    data = [recorded(seed=seed, length=12) for seed in range(4)]
    model = tiny(path, env=DotEnv(), dataset=data, guidance=1.0)
    before = weights(model)
    model.learn(60)
    assert model.updates > 0
    after = weights(model)
    for name in ("world_model.rssm.gru.gates.weight", "actor.from_stoch.weight"):
        assert not torch.equal(before[name], after[name])
    assert all(torch.isfinite(w).all() for w in after.values())
    model.save(tmp_path / "tuned.zip")
    assert same(weights(WPT.load(tmp_path / "tuned.zip")), after)


def test_the_first_update_does_not_initialise_their_posterior_again():
    model = tiny(dataset=[recorded()], env=DotEnv(), learning_rate=0.0, weight_decay=0.0)
    before = weights(model, "world_model")
    model.learn(30)
    assert model.updates > 0 and same(before, weights(model, "world_model"))


def test_widths_are_the_files_and_not_to_be_given():
    with pytest.raises(ValueError, match=r"max_action_dim is read from .*leave it out"):
        tiny(max_action_dim=12)
    with pytest.raises(ValueError, match="No keyword 'gama'"):
        tiny(gama=0.9)


def test_groups_that_32_does_not_divide_are_guessed_with_a_warning():
    with pytest.warns(UserWarning, match="assuming 4 groups of 6 classes; pass stoch="):
        model = WPT.from_official(TINY, device="cpu")
    assert (model.policy.size.stoch, model.policy.size.classes) == (4, 6)


# -------------------------------------------------------------------------------- refused files


class Payload:
    """Writes a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (Path.touch, (self.path,))


def cut(path):
    path.write_bytes(TINY.read_bytes()[:300_000])


def flipped(path):
    content = bytearray(TINY.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(bytes(content))


def changed(part, name, value):
    """Writes the tiny file with another tensor in place of one; None removes it."""

    def write(path):
        content = read(TINY)
        state = content
        for key in part.split("."):
            state = state[key]
        del state[name]
        if value is not None:
            state[name] = value
        torch.save(content, path)

    return write


RECURRENT = torch.zeros(8, 8, 20), torch.zeros(8, 8, 24, dtype=torch.float16)


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (cut, "is cut short or damaged"),
        (flipped, "is cut short or damaged .*checksum"),
        (lambda path: path.write_bytes(b""), "is cut short or damaged"),
        (lambda path: path.write_text("hello"), "not an archive of torch"),
        (
            lambda path: torch.save({"wm": Payload(path.with_name("run"))}, path),
            "could run foreign code",
        ),
        (
            lambda path: path.write_bytes(pickle.dumps(Payload(path.with_name("run")))),
            "is not an archive of torch",
        ),
        (lambda path: agent().save(path), r"is for WPT\.load"),
        (lambda path: torch.save({"model": {}}, path), "has no world model under 'wm'"),
        (lambda path: torch.save(torch.zeros(3), path), "has no world model under 'wm'"),
        (
            lambda path: torch.save({"wm": {"encoder": {}}}, path),
            "whose parts are .*has wm.encoder",
        ),
        (lambda path: torch.save(read(TINY) | {"step": 3}, path), "whose parts are .* step, "),
        (lambda path: torch.save(read(TINY) | {"actor": 3}, path), "actor is no state dict"),
        (changed("wm.rssm", "_gru._dyngru.weight", None), r"wm\.rssm lacks _gru\._dyngru\.weight"),
        (changed("wm.rssm", "_gru._dyngru.weight", RECURRENT[0]), r"\(8, 8, 20\).*\(8, 8, 24\)"),
        (
            changed("wm.rssm", "_gru._dyngru.weight", RECURRENT[1]),
            "_dyngru.weight is torch.float16",
        ),
        (changed("wm.rssm", "_gru._dyngru.weight", RECURRENT[0][0]), "has another architecture"),
        (changed("wm.rssm", "_gru._dyngru.weight", 3), "_dyngru.weight is int"),
        (changed("wm.rssm", "_gru._in_deter.0.weight", torch.zeros(32, 60)), "deter=60 cannot be"),
        (
            lambda path: torch.save(read(TINY) | {"reward": read(TINY)["critic"]}, path),
            "its reward has an unknown _net.7.weight",
        ),
    ],
)
def test_a_file_that_is_not_theirs_is_refused_in_one_sentence(write, message, tmp_path):
    write(tmp_path / "model.pt")
    with pytest.raises(ValueError, match=message) as refusal:
        tiny(tmp_path / "model.pt")
    assert "\n" not in str(refusal.value)
    assert not (tmp_path / "run").exists()  # what a pickle would have run


def test_other_mistakes_are_refused_by_name(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"There is no model file .*nothing\.pt"):
        tiny(tmp_path / "nothing.pt")
    with pytest.raises(ValueError, match=r"a z of 24 numbers, no multiple of stoch=7"):
        WPT.from_official(TINY, stoch=7)


def test_every_tensor_of_a_policy_but_the_clones_has_a_name_of_theirs():
    policy = tiny().policy
    modules = {module for module, _ in PARTS.values()}
    parts = [*policy.named_children()]
    parts += [(f"world_model.{m}", part) for m, part in policy.world_model.named_children()]
    named = {m for m, part in parts if list(part.parameters())} - {"world_model"}  # by default
    assert named - modules == {"prior_actor"}
