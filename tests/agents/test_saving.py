"""The model file: what comes back, what goes on, and what is refused."""

import errno
import io
import json
import os
import pickle
import zipfile
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from debug_agent import SETTINGS, ClockEnv, agent, noise, pretrained, recorded, same, weights
from sameness import FURTHER
from stable_baselines3 import SAC

from wpt_agents.agents.wpt import WPT
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.files import archive, model_file
from wpt_agents.files.model_file import read_model, write_model
from wpt_agents.model.sizes import SIZES
from wpt_agents.training.progress import WPTProgress


@pytest.fixture
def store(tmp_path):
    with TrajectoryDataset.create(tmp_path / "data") as dataset:
        dataset.extend(recorded(seed=i) for i in range(4))
    return dataset


@pytest.fixture
def learnt(store):
    return pretrained(store, env=ClockEnv()).learn(28)


def acts(model, steps=4):
    """What a model does over some steps, deterministically."""
    state, actions = None, []
    for step in range(steps):
        action, state = model.predict(noise(2, seed=step), state, deterministic=True)
        actions.append(action)
    return np.stack(actions)


# ------------------------------------------------------------------------ what comes back


def test_a_loaded_model_acts_the_same(learnt, tmp_path):
    learnt.save(tmp_path / "model.zip")
    loaded = WPT.load(tmp_path / "model.zip")
    np.testing.assert_array_equal(acts(loaded), acts(learnt))
    prior = [m.prior.predict(noise(2))[0] for m in (learnt, loaded)]
    np.testing.assert_array_equal(*prior)


def test_a_loaded_model_has_the_same_settings_and_counters(learnt, tmp_path):
    learnt.save(tmp_path / "model.zip")
    loaded = WPT.load(tmp_path / "model.zip", gamma=0.9)
    assert loaded.hyperparameters == learnt.hyperparameters.resolved().changed(gamma=0.9)
    assert loaded.gamma == 0.9 and loaded.num_timesteps == 28
    assert loaded.retrieved_ids == learnt.retrieved_ids and loaded.updates == learnt.updates


def test_an_untrained_model_and_an_open_file_will_do():
    model, file = agent(), io.BytesIO()
    model.save(file)
    assert same(weights(WPT.load(file)), weights(model))


def test_the_suffix_is_added_only_where_there_is_none(tmp_path):
    model = agent()
    for name in ("plain", "model.v2", "model.zip"):
        model.save(tmp_path / "new" / name)
        assert same(weights(WPT.load(tmp_path / "new" / name)), weights(model))
    assert {p.name for p in (tmp_path / "new").iterdir()} == {"plain.zip", "model.v2", "model.zip"}


def test_a_model_of_numpys_numbers_is_saved(tmp_path):
    numbers = {"gamma": np.float32(0.5), "max_action_dim": np.int64(3), "seed": np.arange(3)[1]}
    agent(return_norm=np.True_, **numbers).save(tmp_path / "model.zip")
    loaded = WPT.load(tmp_path / "model.zip")
    assert (loaded.gamma, loaded.max_action_dim, loaded.seed) == (0.5, 3, 1)


@pytest.mark.parametrize("as_fields", [False, True])
def test_a_size_without_a_name_is_saved_with_its_fields(tmp_path, as_fields):
    size = replace(SIZES["debug"], depth=8, gates="across", norm_eps=1e-5)
    model = agent(size=asdict(size) if as_fields else size)
    model.save(tmp_path / "model.zip")
    loaded = WPT.load(tmp_path / "model.zip")
    assert loaded.policy.size == size
    assert same(weights(loaded), weights(model))
    np.testing.assert_array_equal(acts(loaded), acts(model))
    with pytest.raises(ValueError, match=r"trained with size=\{'deter': 64"):
        WPT.load(tmp_path / "model.zip", size="debug")


def test_a_size_equal_to_a_named_one_is_saved_by_its_name(tmp_path):
    model = agent(size=replace(SIZES["tiny"]))
    assert model.hyperparameters.size == model.size == "tiny"


def test_a_dotted_name_never_loads_another_file(tmp_path):
    agent().save(tmp_path / "model.zip")
    with pytest.raises(FileNotFoundError, match=r"model\.v2"):
        WPT.load(tmp_path / "model.v2")


def test_an_unknown_name_is_refused_with_the_models_that_come_with_the_library(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no model file nothing\.zip, .*metaworld-mid"):
        WPT.load("nothing")


def test_the_folder_in_which_one_is_is_refused_as_any_other(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"\. is a folder, which holds no model file"):
        WPT.load(".")


def test_a_folder_is_refused_with_the_files_it_holds(tmp_path):
    run = tmp_path / "walker_0"
    run.mkdir()
    with pytest.raises(FileNotFoundError, match="walker_0 is a folder, which holds no model file"):
        WPT.load(run)
    for name in ("model", "best_model"):
        agent(ClockEnv()).save(run / name)
    with pytest.raises(FileNotFoundError, match=r"holds best_model.zip, model.zip: pass the file"):
        WPT.load(run)
    agent(ClockEnv(), gamma=0.8).save(tmp_path / "walker_0")  # beside the folder
    assert WPT.load(tmp_path / "walker_0").gamma == 0.8


def test_the_file_is_json_and_safetensors_and_holds_no_data(learnt, tmp_path):
    learnt.save(tmp_path / "model.zip")
    names = zipfile.ZipFile(tmp_path / "model.zip").namelist()
    assert names[0] == "about.json" and all(n.endswith(".safetensors") for n in names[1:])
    weight = sum(v.nbytes for v in weights(learnt).values())
    assert (tmp_path / "model.zip").stat().st_size < 3.5 * weight  # Adam keeps two averages


def test_parameters_can_be_taken_out_and_put_in():
    one, other = agent(ClockEnv()).learn(28), agent(seed=1)
    other.set_parameters(one.get_parameters())
    assert same(weights(one), weights(other))
    was, now = (m.learner.model_optimizer.state_dict()["state"][0]["exp_avg"] for m in (one, other))
    assert torch.equal(was, now)


# ------------------------------------------------------------------------------ what goes on


def test_learning_after_load_with_the_replay_equals_learning_in_one_go(tmp_path):
    whole, part = agent(ClockEnv()).learn(56), agent(ClockEnv()).learn(28)
    part.save(tmp_path / "model")
    part.save_replay_buffer(tmp_path / "replay.pkl")
    loaded = WPT.load(tmp_path / "model", env=ClockEnv(), device="cpu")
    loaded.load_replay_buffer(tmp_path / "replay.pkl")
    loaded.learn(28, reset_num_timesteps=False)
    assert loaded.num_timesteps == 56 and loaded.updates == whole.updates
    assert same(weights(loaded), weights(whole))


def test_a_resumed_run_of_all_keywords_equals_one_that_was_never_interrupted(store, tmp_path):
    settings = {
        **FURTHER,
        "kickstart": "adaptive(20,1)",
        "actor_critic_decay": False,  # which goes by the steps of the call of `learn`
        "guidance": "linear(1,0,60)",
        "recent_share": 0.5,
        "max_trajectory_length": 5,
        "warmup_steps": 14,
        "train_ratio": 2,
    }

    def begun(steps):
        return pretrained(store, env=ClockEnv(terminates=True), **settings).learn(steps)

    whole, part = begun(42), begun(21)
    part.save(tmp_path / "model")
    part.save_replay_buffer(tmp_path / "replay")
    rest = WPT.load(tmp_path / "model", env=ClockEnv(terminates=True), dataset=store)
    rest.load_replay_buffer(tmp_path / "replay")
    rest.learn(21, reset_num_timesteps=False)
    assert rest.progress == whole.progress and whole.updates > part.updates > 0
    assert same(weights(rest), weights(whole))


def test_learning_goes_on_without_replay_and_keeps_what_was_retrieved(learnt, store, tmp_path):
    learnt.save(tmp_path / "model")
    loaded = WPT.load(tmp_path / "model", env=ClockEnv(), dataset=store.path)
    loaded.learn(28, reset_num_timesteps=False)
    assert loaded.num_timesteps == 56 and loaded.updates > learnt.updates
    assert loaded.retrieved_ids == learnt.retrieved_ids
    assert len(loaded.retrieved.trajectories) == 3


def test_learning_on_without_the_dataset_says_that_rehearsal_ends(learnt, tmp_path):
    learnt.save(tmp_path / "model")
    with pytest.warns(UserWarning, match="rehearses nothing: load it with dataset="):
        WPT.load(tmp_path / "model", env=ClockEnv()).learn(7)
    WPT.load(tmp_path / "model", env=ClockEnv(), offline_ratio=0).learn(7)


def test_the_replay_file_is_whole_or_refused(learnt, tmp_path):
    learnt.save_replay_buffer(tmp_path / "replay.pkl")
    assert [p.name for p in tmp_path.glob("replay*")] == ["replay.pkl"]
    damaged = (tmp_path / "replay.pkl").read_bytes()[:-50]
    (tmp_path / "replay.pkl").write_bytes(damaged)
    with pytest.raises(ValueError, match="damaged or not a ReplayBuffer"):
        learnt.load_replay_buffer(tmp_path / "replay.pkl")
    assert len(learnt.replay_buffer) == 28


# -------------------------------------------------------------------------- nothing is lost


@pytest.mark.parametrize("where", [(archive.os, "fsync"), (model_file, "write_tensors")])
def test_a_failing_write_keeps_the_old_file(tmp_path, monkeypatch, where):
    old, new = agent(), agent(seed=1)
    old.save(tmp_path / "model.zip")

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch, pytest.raises(OSError, match="No space"):
        patch.setattr(*where, full)
        new.save(tmp_path / "model.zip")
    assert same(weights(WPT.load(tmp_path / "model.zip")), weights(old))
    assert os.listdir(tmp_path) == ["model.zip"]


# -------------------------------------------------------------------------- what is refused


@pytest.fixture
def small():
    file = io.BytesIO()
    write_model(file, {"counters": {"updates": 3}}, {"policy": {"a": torch.arange(4.0)}})
    return file.getvalue()


def test_a_file_cut_short_anywhere_is_refused(small):
    for length in range(len(small)):
        with pytest.raises(ValueError, match="load another copy"):
            read_model(io.BytesIO(small[:length]))


def test_a_flipped_bit_anywhere_is_refused_or_does_no_harm(small):
    (header, tensors), refused = read_model(io.BytesIO(small)), 0
    for i in range(len(small)):
        damaged = small[:i] + bytes([small[i] ^ (1 << i % 8)]) + small[i + 1 :]
        try:
            reread, groups = read_model(io.BytesIO(damaged))
        except ValueError as error:
            assert "load another copy" in str(error)
            refused += 1
        else:  # a date in the zip's directory, say
            assert reread == header and torch.equal(groups["policy"]["a"], tensors["policy"]["a"])
    assert refused > len(small) / 2


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no model file .*nowhere\.zip"):
        WPT.load(tmp_path / "nowhere")


def zipped(path, **members):
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name.replace("_", "."), content)


OURS = json.dumps({"kind": "wpt_agents model", "version": 1})


@pytest.mark.parametrize(
    ("members", "reason"),
    [
        ({}, "no about.json"),
        ({"about_json": "[]"}, "is damaged"),
        ({"about_json": "{"}, "is damaged"),
        ({"about_json": json.dumps({"kind": "ReplayBuffer", "version": 1})}, "'ReplayBuffer'"),
        ({"about_json": OURS.replace("1", "99")}, "version 99: update wpt_agents"),
        ({"about_json": OURS, "policy_safetensors": b"nonsense"}, "is damaged"),
        ({"about_json": OURS, "policy_pth": b"nonsense"}, "policy.pth"),
    ],
)
def test_a_zip_that_is_not_ours_is_refused(tmp_path, members, reason):
    zipped(tmp_path / "model.zip", **members)
    with pytest.raises(ValueError, match=reason):
        WPT.load(tmp_path / "model.zip")


def test_a_text_is_refused(tmp_path):
    (tmp_path / "model.zip").write_text("weights")
    with pytest.raises(ValueError, match="not a zip file"):
        WPT.load(tmp_path / "model.zip")


def test_another_algorithms_file_is_refused(tmp_path):
    SAC("MlpPolicy", "Pendulum-v1", buffer_size=1).save(tmp_path / "sac.zip")
    with pytest.raises(ValueError, match="not a model of wpt_agents"):
        WPT.load(tmp_path / "sac.zip")


class Trap:
    def __reduce__(self):
        return os.mkdir, (os.environ["TRAP"],)


def test_a_pickle_in_the_file_is_refused_and_never_run(tmp_path, monkeypatch):
    monkeypatch.setenv("TRAP", str(tmp_path / "sprung"))
    content = pickle.dumps(Trap())
    for name in ("data", "policy_pth", "about_json", "policy_safetensors", "extra_pkl"):
        agent().save(tmp_path / "model.zip")
        with zipfile.ZipFile(tmp_path / "model.zip", "a") as file:
            file.writestr("x." + name.replace("_", "."), content)
        with pytest.raises(ValueError, match="load another copy"):
            WPT.load(tmp_path / "model.zip")
    assert not (tmp_path / "sprung").exists()


def test_other_widths_than_the_files_are_refused_with_both(tmp_path):
    agent().save(tmp_path / "model")
    with pytest.raises(ValueError, match="size='debug', now it is 'tiny'"):
        WPT.load(tmp_path / "model", size="tiny")
    with pytest.raises(ValueError, match="max_action_dim=4, now it is 5"):
        WPT.load(tmp_path / "model", max_action_dim=5)


def test_a_model_saved_on_one_device_loads_on_another(tmp_path):
    agent(device="cpu").save(tmp_path / "model")
    loaded = WPT.load(tmp_path / "model", device="auto")
    expected = "cuda" if torch.cuda.is_available() else "cpu"
    assert loaded.device.type == expected and SETTINGS["device"] == "cpu"


def test_a_file_without_a_counter_is_refused_by_name(learnt, tmp_path):
    learnt.save(tmp_path / "model")
    header, tensors = read_model(tmp_path / "model.zip")
    del header["counters"]["credit"], header["groups"]
    write_model(tmp_path / "old.zip", header, tensors)
    with pytest.raises(ValueError, match="lacks credit: it was written by an earlier"):
        WPT.load(tmp_path / "old.zip")


# A world model to share


def test_a_shared_world_model_holds_no_other_network_and_no_path(store, tmp_path):
    model = pretrained(store, steps=3)
    model.save_world_model(tmp_path / "shared.zip")
    header, tensors = read_model(tmp_path / "shared.zip")
    assert list(tensors) == ["world_model"] and "dataset" not in header
    names = {".".join(name.split(".")[:2]) for name in tensors["world_model"]}
    assert names == {"world_model.encoder", "world_model.rssm", "world_model.decoder"}
    assert {tensor.dtype for tensor in tensors["world_model"].values()} == {torch.bfloat16}


def test_a_shared_world_model_is_the_model_rounded_and_can_be_fine_tuned(store, tmp_path):
    model = pretrained(store, steps=3)
    model.save_world_model(tmp_path / "shared.zip")
    loaded = WPT.load(tmp_path / "shared.zip", env=ClockEnv(), dataset=store)
    assert loaded.pretrain_steps == 3
    for part in ("encoder", "rssm", "decoder"):
        kept = getattr(model.policy.world_model, part).state_dict()
        for name, tensor in getattr(loaded.policy.world_model, part).state_dict().items():
            assert torch.equal(tensor, kept[name].bfloat16().float()), name
    loaded.learn(60)
    assert loaded.updates > 0


def test_a_shared_world_model_begins_a_task_from_its_start(learnt, store, tmp_path):
    assert learnt.progress.cloned and learnt.updates > 0
    learnt.save_world_model(tmp_path / "shared.zip")
    loaded = WPT.load(tmp_path / "shared.zip", env=ClockEnv(), dataset=store, bin_range=7.0)
    assert loaded.progress == WPTProgress(pretrain_steps=2, initialised=True)
    assert loaded.prior is None  # and not the initial weights of one
    loaded.set_parameters(tmp_path / "shared.zip")  # has no heads whose bins could differ
    before = weights(loaded, "prior_actor")
    loaded.learn(7)
    assert loaded.progress.cloned and not same(weights(loaded, "prior_actor"), before)


def test_a_shipped_model_is_found_by_its_name(store, tmp_path, monkeypatch):
    pretrained(store).save_world_model(tmp_path / "toy-mid.zip")
    shipped = {"toy-mid": tmp_path / "toy-mid.zip"}
    monkeypatch.setattr("wpt_agents.training.model_files.shipped", lambda: shipped)
    assert WPT.load("toy-mid").pretrain_steps == 2
    with pytest.raises(FileNotFoundError, match="toy-tiny"):
        WPT.load("toy-tiny")
