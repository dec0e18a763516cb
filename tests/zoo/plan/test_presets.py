import csv
import re
from contextlib import closing
from statistics import mean, median

import gymnasium as gym
import numpy as np
import pytest
from debug_agent import ClockEnv, recorded
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv

from wpt_agents.agents.base import PixelAgent
from wpt_agents.agents.drqv2 import DrQv2
from wpt_agents.agents.jsrl import JSRL
from wpt_agents.agents.mrq import MRQ
from wpt_agents.agents.wpt import WPT
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.training.guidance import parse_schedule
from wpt_agents.zoo.plan import presets
from wpt_agents.zoo.plan.methods import METHODS, defaults
from wpt_agents.zoo.plan.presets import (
    load_preset,
    preset_folder,
    preset_names,
    read_yaml,
    suite_names,
)
from wpt_agents.zoo.plan.request import Request
from wpt_agents.zoo.plan.runs import make_plan, parse_seeds
from wpt_agents.zoo.plan.shared import given_file
from wpt_agents.zoo.run.learning import make_agent
from wpt_agents.zoo.tasks import find_tasks

ALL = [(suite, name) for suite in suite_names() for name in preset_names(suite)]


@pytest.mark.parametrize(("suite", "name"), ALL)
def test_every_preset_holds_valid_keywords_and_tasks_that_exist(suite, name):
    preset = load_preset(suite, name)
    rows = find_tasks(suite, preset.collect.tasks)
    assert suite != "dmc" or len({row.embodiment for row in rows}) >= 2  # several robots
    assert preset.wpt["max_action_dim"] >= max(row.action_dim for row in rows)


def test_the_paper_preset_is_table_2():
    preset = load_preset("dmc", "paper")
    table = {
        "size": "paper",
        "batch_size": 16,
        "batch_length": 64,
        "guidance": "linear(1,0,50000)",
        "offline_ratio": 0.25,
        "gamma": 0.99,
        "lam": 0.95,
        "ent_coef": 1e-4,
        "imagine_horizon": 16,
    }
    assert {key: preset.wpt[key] for key in table} == table
    assert (preset.pretrain.steps, preset.learn.frames) == (200_000, 150_000)
    assert preset.wpt["warmup_steps"] * preset.env.action_repeat == 15_000


@pytest.mark.parametrize("name", ["mid", "paper"])
def test_guidance_of_meta_world_falls_over_twice_the_run_as_in_the_paper(name):
    preset = load_preset("metaworld", name)
    assert preset.wpt["guidance"] == f"linear(1,0.1,{2 * preset.steps})"


@pytest.mark.parametrize(("suite", "name"), ALL)
def test_the_clone_of_jsrl_drives_no_warm_up(suite, name):
    # horizons alone decide where the clone acts, as in appendix G of the paper's later version
    preset = load_preset(suite, name)
    assert {**defaults(JSRL), **preset.of_agent(JSRL)}["warmup_steps"] == 0


@pytest.mark.parametrize(("suite", "name"), [x for x in ALL if x[1] in ("demo", "tiny", "mid")])
def test_the_noise_of_drqv2_has_faded_by_the_middle_of_a_short_run(suite, name):
    preset = load_preset(suite, name)
    std = parse_schedule(preset.of_agent(DrQv2)["std"], np.inf)
    assert std(0) == 1.0 and std(preset.steps // 2) == pytest.approx(0.1)


def test_frames_become_calls_of_step_by_the_action_repeat():
    assert load_preset("dmc", "debug", ["learn.frames=150_000"]).steps == 75_000
    settings = ["learn.frames=150_000", "env.action_repeat=4"]
    assert load_preset("dmc", "debug", settings).steps == 37_500


def test_settings_change_keywords_and_sections():
    preset = load_preset("dmc", "debug", ["gamma=0.9", "collect.tasks=[a, b]", "pretrain.steps=7"])
    assert (preset.wpt["gamma"], preset.collect.tasks) == (0.9, ("a", "b"))
    assert preset.pretrain.steps == 7


def test_numbers_without_a_dot_in_the_exponent_are_numbers():
    assert read_yaml("[1e-4, 3E+2, 4e4, -1e-3, 1_0e1]") == [1e-4, 300, 40_000, -1e-3, 100]


def test_yaml_runs_no_code():
    with pytest.raises(presets.yaml.YAMLError):
        read_yaml("!!python/object/apply:os.system ['true']")


@pytest.mark.parametrize(
    ("suite", "name", "settings", "message"),
    [
        ("dmv", "demo", [], "'dmv'.*Did you mean 'dmc'"),
        ("dmc", "demmo", [], "'demmo'.*Did you mean 'demo'"),
        ("dmc", "demo", ["gama=0.9"], "'gama'.*Did you mean 'gamma'"),
        ("dmc", "demo", ["gama=0.9"], r"free_nats_mode, gamma, grad_clip.*, learn\.KEY, "),
        ("dmc", "demo", ["frames=9"], r"Did you mean 'learn\.frames'"),
        ("dmc", "demo", ["learn.frame=1"], "learn key 'frame'.*Did you mean 'frames'"),
        ("dmc", "demo", ["lern.frames=1"], "section 'lern'.*Did you mean 'learn'"),
        ("dmc", "demo", ["frames=1"], "'frames'.*learn.frames"),
        ("dmc", "demo", ["learn.frames=many"], "learn.frames must be of type int, got 'many'"),
        ("dmc", "demo", ["collect.tasks=walker-run"], "list of names, got .walker-run"),
        ("dmc", "demo", ["sac.gamma=abc"], "gamma of SAC must be of type float.*got 'abc'"),
        ("dmc", "demo", ["sac.train_freq=[1, episode]"], "train_freq of SAC must be of type int"),
        ("dmc", "demo", ["learn.frames=1"], "at least 1, got 1 / 2"),
        ("dmc", "demo", ["evaluate.episodes=0"], "evaluate.episodes.*at least 1"),
        ("dmc", "demo", ["pretrain.steps=-1"], "pretrain.steps must not be negative"),
        ("dmc", "demo", ["pretrain.steps=0"], "pretrain.steps must be at least 1, got 0"),
        ("dmc", "demo", ["evaluate.during_episodes=0"], "during_episodes must be at least 1"),
        ("dmc", "demo", ["seed=1"], "'seed'"),
        ("dmc", "demo", ["gamma"], "key=value"),
    ],
)
def test_what_does_not_exist_is_answered_with_the_nearest(suite, name, settings, message):
    with pytest.raises(ValueError, match=message):
        load_preset(suite, name, settings)


def test_a_suite_file_with_a_wrong_key_names_it(tmp_path, monkeypatch):
    (tmp_path / "dmc.yaml").write_text("default: {wpt: {gamme: 1}}\npresets: {demo: {}}\n")
    monkeypatch.setattr(presets, "preset_folder", lambda: tmp_path)
    with pytest.raises(ValueError, match=r"WPT keyword 'gamme'.*Did you mean 'gamma'"):
        load_preset("dmc", "demo")


@pytest.mark.parametrize(
    ("text", "seeds"), [("3", [0, 1, 2]), ("0,5", [0, 5]), ("2-4", [2, 3, 4]), ("1,3-4", [1, 3, 4])]
)
def test_seeds_are_how_many_or_which(text, seeds):
    assert parse_seeds(text) == seeds


@pytest.mark.parametrize("text", ["", "0", "x", "1-", "3-1", "0,3-1", "1-2-3"])
def test_seeds_that_are_none_are_refused(text):
    with pytest.raises(ValueError, match="how many"):
        parse_seeds(text)


def test_a_seed_that_a_run_would_stumble_over_is_refused():
    assert parse_seeds("4294967295-4294967295") == [2**32 - 1]
    with pytest.raises(ValueError, match="at most 4294967295"):
        parse_seeds("0,4294967296")


@pytest.mark.parametrize(
    ("patterns", "names"),
    [
        (["walker-run"], ["walker-run"]),
        (["dmc-walker-run"], ["walker-run"]),
        (["wpt/dmc-walker-run-v0"], ["walker-run"]),
        (["acrobot-*"], ["acrobot-swingup", "acrobot-swingup-sparse", "acrobot-swingup-hard"]),
    ],
)
def test_tasks_are_found_by_name_id_or_pattern(patterns, names):
    assert [row.name for row in find_tasks("dmc", patterns)] == names


def test_no_pattern_means_the_papers_22_tasks():
    assert len(find_tasks("dmc", [])) == 22
    assert len(find_tasks("robotics", [])) == 12  # none of which is the paper's


@pytest.mark.parametrize(("suite", "name"), [("dmc", "walker-rum"), ("dmd", "walker-run")])
def test_an_unknown_task_or_suite_is_answered_with_the_nearest(suite, name):
    with pytest.raises(ValueError, match=r"Did you mean '(walker-run|dmc)'"):
        find_tasks(suite, [name])


def reference(numbers, method, samples):
    """The scores of a method's tasks, and the printed mean and median."""
    scores, printed = [], {}
    for number in numbers:
        with open(preset_folder() / "references" / f"table{number}.csv") as file:
            for row in csv.DictReader(file):
                if (row["method"], row["samples"]) != (method, str(samples)) or not row["score"]:
                    continue
                if row["task"] in ("mean", "median"):
                    printed[row["task"]] = float(row["score"])
                else:
                    scores.append(float(row["score"]))
    return scores, printed


@pytest.mark.parametrize(
    ("method", "samples"),
    [("wpt", 150_000), ("drq-v2", 150_000), ("dreamer-v3", 150_000), ("dreamer-v3", 500_000)],
)
def test_table_5_adds_up_to_its_printed_mean_and_median(method, samples):
    scores, printed = reference([5], method, samples)
    assert len(scores) == 22
    assert mean(scores) == pytest.approx(printed["mean"], abs=0.01)
    assert median(scores) == pytest.approx(printed["median"], abs=0.01)


def test_tables_3_and_4_have_50_tasks_and_a_misprinted_mean():
    scores, printed = reference([3, 4], "wpt", 150_000)
    assert len(scores) == 50
    assert mean(scores) == pytest.approx(0.7536)
    scores, printed = reference([3, 4], "dreamer-v3", 1_000_000)
    assert mean(scores) == pytest.approx(0.656, abs=0.001)
    assert printed["mean"] == 0.9  # the paper's print


def test_every_reference_names_a_task_that_exists_and_its_source():
    for number, suite in ((3, "metaworld"), (4, "metaworld"), (5, "dmc")):
        with open(preset_folder() / "references" / f"table{number}.csv") as file:
            for row in csv.DictReader(file):
                assert row["source"].endswith(f"Table {number}")
                assert ("ICLR 2026" in row["source"]) == (row["method"] == "ncrl")
                assert row["task"] in ("mean", "median") or find_tasks(suite, [row["task"]])


def test_the_later_version_of_the_paper_has_a_score_for_every_task():
    scores, printed = reference([5], "ncrl", 150_000)
    assert len(scores) == 22 and mean(scores) == pytest.approx(619.55, abs=0.01)
    assert printed == {"mean": 617.73, "median": 733.3}  # the mean is misprinted
    assert median(scores) == pytest.approx(733.3, abs=0.01)
    scores, printed = reference([3, 4], "ncrl", 150_000)
    assert len(scores) == 50 and mean(scores) == pytest.approx(printed["mean"], abs=0.001)
    assert median(scores) == pytest.approx(printed["median"], abs=0.001)


def test_the_authors_own_numbers_name_repository_and_commit():
    with open(preset_folder() / "references" / "official.csv") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 8 * 3 * 2
    for row in rows:
        assert find_tasks("dmc", [row["task"]]) and re.search(r"at [0-9a-f]{7}, ", row["source"])
        assert row["sd"] or row["samples"] == "500000" or row["method"] == "mrq-official"


def plan(suite, tasks, preset, tmp_path, method="wpt", settings=(), data=None):
    request = Request(preset, methods=[method], settings=settings, out=tmp_path, data=data)
    return make_plan(suite, tasks, request)


@pytest.mark.parametrize(("suite", "preset"), ALL)
def test_a_whole_suite_can_be_run_from_its_presets_own_data(suite, preset, tmp_path):
    if (suite, preset) == ("dmc", "tiny"):  # the small benchmark's data hold no quadruped
        with pytest.raises(ValueError, match=r"quadruped.* 12 actions, .*add such a task"):
            plan(suite, [], preset, tmp_path)
    else:
        assert plan(suite, [], preset, tmp_path)


TASK_OF = {"dmc": "walker-run", "metaworld": "reach", "robotics": "fetch-reach"}
SMALL = [(suite, name) for suite, name in ALL if name in ("debug", "tiny")]


@pytest.mark.parametrize("method", METHODS)
def test_every_method_can_be_planned_from_every_preset(method, tmp_path):
    for suite, preset in ALL:
        [run] = plan(suite, [TASK_OF[suite]], preset, tmp_path, method)
        agent = run.algorithm.agent
        assert run.keywords.keys() <= defaults(agent).keys(), (suite, preset)
        if issubclass(agent, PixelAgent):
            agent.keywords.of(run.keywords)  # names and ranges
        assert run.config() and run.folder and run.shared.model_path


@pytest.mark.parametrize(("suite", "preset"), ALL)
def test_all_methods_have_the_same_frames_evaluations_and_choice_of_the_best_policy(
    suite, preset, tmp_path
):
    request = Request(preset, "7-7", list(METHODS), out=tmp_path)
    runs = make_plan(suite, [TASK_OF[suite]], request)
    assert [run.method for run in runs] == list(METHODS)
    budgets = {(run.preset.learn, run.preset.evaluate, run.evaluation_seed) for run in runs}
    assert len(budgets) == 1


@pytest.mark.parametrize("preset", ["demo", "mid"])
def test_only_wpt_starts_from_the_world_model_of_the_library(preset, tmp_path):
    [ours] = plan("metaworld", ["reach"], preset, tmp_path, "wpt")
    [r3m] = plan("metaworld", ["reach"], preset, tmp_path, "r3m")
    assert ours.shared.given_model == "metaworld-mid"
    assert r3m.algorithm.pretrained
    assert not r3m.shared.given_model


@pytest.mark.parametrize("name", ["wpt/metaworld-reach-v0", "metaworld-reach", "reach"])
def test_baselines_use_data_of_their_task_also_where_imported_data_call_it_otherwise(
    name, tmp_path
):
    with TrajectoryDataset.create(tmp_path / "data") as data:
        for task in (name, "push"):
            data.append(recorded(actions=4, embodiment="sawyer", task=task))
    [run] = plan("metaworld", ["reach"], "debug", tmp_path, "uds")
    agent = make_agent(run, DummyVecEnv([lambda: ClockEnv(actions=4)]), data, None)
    agent.prepare(progress_bar=False)
    assert agent.retrieved_ids == [0]


@pytest.mark.parametrize("method", METHODS)
def test_every_method_is_built_from_the_small_presets(method, tmp_path):
    for suite, preset in SMALL:
        [run] = plan(suite, [TASK_OF[suite]], preset, tmp_path, method)
        actions = spaces.Box(-1.0, 1.0, (run.task.action_dim,), np.float32)
        with closing(DummyVecEnv([lambda box=actions: Still(box)])) as venv:
            wrapped = run.algorithm.wrap(venv)
            agent = make_agent(run, wrapped, None, None)
            action, _ = agent.predict(wrapped.reset(), deterministic=True)
        assert action.shape == (1, run.task.action_dim), (suite, preset)


class Still(gym.Env):
    """An environment of a task's spaces in which nothing happens."""

    observation_space = spaces.Box(0, 255, (64, 64, 3), np.uint8)

    def __init__(self, actions):
        self.action_space = actions

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros((64, 64, 3), np.uint8), {}

    def step(self, action):
        return np.zeros((64, 64, 3), np.uint8), 0.0, False, False, {}


def test_a_robot_that_the_data_do_not_show_is_refused_before_any_work(tmp_path):
    settings = ["max_action_dim=12"]
    with pytest.raises(ValueError, match=r"quadruped-walk has 12 actions.*\(1, 6\).*collect.tasks"):
        plan("dmc", ["quadruped-walk"], "tiny", tmp_path, settings=settings)
    assert plan("dmc", ["quadruped-walk"], "tiny", tmp_path, "scratch", settings)
    assert plan("dmc", ["quadruped-walk"], "tiny", tmp_path, "pretrain-only", settings)
    with TrajectoryDataset.create(tmp_path / "own") as dataset:
        dataset.append(recorded(actions=12))
    arguments = dict(settings=settings, data=tmp_path / "own")
    assert plan("dmc", ["quadruped-walk"], "tiny", tmp_path, **arguments)
    with pytest.raises(ValueError, match=r"walker-walk has 6 actions.*\(12\)") as error:
        plan("dmc", ["walker-walk"], "tiny", tmp_path, **arguments)
    assert "collect.tasks" not in str(error.value)  # which the user's data replace


@pytest.mark.parametrize("method", ["wpt", "pretrain-only", "r3m"])
def test_data_without_a_trajectory_are_refused_before_any_work(method, tmp_path):
    TrajectoryDataset.create(tmp_path / "own").close()
    where = "dmc", ["walker-walk"], "demo", tmp_path
    with pytest.raises(ValueError, match=r"--data .*own holds no trajectories"):
        plan(*where, method, data=tmp_path / "own")
    assert plan(*where, "scratch", data=tmp_path / "own")  # which uses no data


def test_data_that_are_too_wide_for_the_model_are_refused_before_any_work(tmp_path):
    settings = ["collect.tasks=[dmc-quadruped-run, dmc-walker-walk]"]
    with pytest.raises(ValueError, match=r"The data have 12 actions.*6: --set max_action_dim=12"):
        plan("dmc", ["walker-walk"], "tiny", tmp_path, settings=settings)
    assert plan("dmc", ["walker-walk"], "tiny", tmp_path, "scratch", settings)


@pytest.mark.parametrize(
    ("setting", "message"),
    [("retrieval=nearst", "nearest"), ("guidance=foo", "guidance='foo'"), ("size=tny", "tiny")],
)
def test_a_choice_or_schedule_that_is_none_is_refused_before_any_work(setting, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        plan("dmc", ["walker-walk"], "demo", tmp_path, settings=[setting])


def test_a_model_that_is_too_narrow_for_a_task_is_refused_with_the_setting(tmp_path):
    with pytest.raises(ValueError, match=r"has 12 actions.*is 6: --set max_action_dim=12"):
        plan("dmc", ["quadruped-walk"], "tiny", tmp_path, "scratch")


@pytest.mark.parametrize(
    ("method", "settings", "message"),
    [
        ("wpt", ["env.rendering=fats"], "Did you mean 'fast'"),
        ("wpt", ["collect.behaviour=nois"], "Did you mean 'noise'"),
        ("wpt", ["collect.behaviour=policy"], "No collect.behaviour 'policy'"),
        ("wpt", ["collect.steps=500"], "collect.steps belongs to collect.behaviour=explore-state"),
        ("kickstart", ["kickstart=5"], "--set kickstart=5 would have no effect"),
        ("scratch", ["guidance=linear(1,0,9)"], "--method scratch sets guidance=0.0"),
        ("scratch", ["plus.kickstart=5"], "--method scratch sets kickstart=0.0"),
        ("uds", ["rlpd.label=true"], "--method uds sets label=zero"),
        (
            "wpt",
            ["plus.kickstart=5"],
            "plus is only used by --method wpt+ and scratch; write --set kickstart",
        ),
        ("drq-v2", ["plus.kickstart=5"], "only used by --method wpt+ and scratch; leave it out"),
        ("wpt", ["sac.gamma=0.5"], "the section sac is not used by --method wpt"),
        ("wpt", ["evaluate.keep_best=true"], "no evaluations are made"),
        ("wpt", ["evaluate.during_episodes=2"], "add --set evaluate.every=FRAMES"),
    ],
)
def test_what_a_run_would_stumble_over_or_overrule_is_refused_beforehand(
    tmp_path, method, settings, message
):
    with pytest.raises(ValueError, match=re.escape(message)):
        plan("dmc", ["walker-run"], "debug", tmp_path, method, settings)


def test_a_method_named_twice_is_one_and_the_last_of_two_settings_counts(tmp_path):
    methods, settings = ["scratch", "scratch"], ["gamma=0.98", "gamma=0.9"]
    request = Request("debug", methods=methods, settings=settings, out=tmp_path)
    [one] = make_plan("dmc", ["walker-run"], request)
    assert (one.keywords["gamma"], str(one.variant)) == (0.9, "debug gamma=0.9")


@pytest.mark.parametrize(("suite", "task"), [("metaworld", "drawer-open"), ("dmc", "walker-walk")])
def test_scratch_has_all_of_wpt_plus_but_data_and_prior_actor(suite, task, tmp_path):
    wpt, plus, scratch = (
        plan(suite, [task], "mid", tmp_path, method)[0] for method in ("wpt", "wpt+", "scratch")
    )
    none = {"guidance": 0.0, "kickstart": 0.0, "ibrl": False, "residual": False}
    assert scratch.keywords == plus.keywords | none | {"offline_ratio": 0.0, "adapt_steps": 0}
    # 1,000 steps earn 1000 * 64 / (16 * 16) = 250 of the head start's 300 updates; 1,500 steps of
    # DMControl earn 1500 * 64 / (16 * 32) = 187.5
    updates = {"metaworld": (1500, 1550), "dmc": (2500, 2612)}
    assert (wpt.updates, plus.updates) == updates[suite] and scratch.updates == plus.updates
    assert wpt.keywords == wpt.preset.wpt and plus.keywords == wpt.preset.wpt | wpt.preset.plus
    assert scratch.keywords["actor_delay"] == 300 and scratch.keywords["actor_critic_decay"]


@pytest.mark.parametrize("method", ["wpt", "wpt+"])
@pytest.mark.parametrize("key", ["kickstart", "wpt.kickstart"])
def test_a_setting_overrules_the_additions_of_the_preset(key, method, tmp_path):
    settings = ["plus.kickstart=7", f"{key}=5"]
    [one] = plan("metaworld", ["drawer-close"], "mid", tmp_path, method, settings)
    assert one.keywords["kickstart"] == 5 and str(one.variant) == "mid kickstart=5"
    assert one.keywords.get("actor_delay") == (300 if method == "wpt+" else None)


@pytest.mark.parametrize("setting", ["gamma=0.9", "wpt.gamma=0.9", " wpt.gamma = 0.9 "])
def test_one_setting_has_one_label_however_it_is_written(setting, tmp_path):
    [one] = plan("dmc", ["walker-run"], "debug", tmp_path, settings=["gamma=0.98", setting])
    assert (one.keywords["gamma"], str(one.variant)) == (0.9, "debug gamma=0.9")


def test_an_empty_value_trains_the_shipped_model_again():
    shipped = load_preset("metaworld", "mid").pretrain
    assert shipped.model == "metaworld-mid"
    assert load_preset("metaworld", "mid", ["pretrain.model="]).pretrain.model == ""


@pytest.mark.parametrize("setting", ["pretrain.steps=5", "size=tiny", "max_action_dim=6"])
def test_settings_that_a_shipped_model_makes_void_are_refused_with_a_remedy_that_works(
    setting, tmp_path
):
    where = "metaworld", ["drawer-close"], "mid", tmp_path
    with pytest.raises(
        ValueError, match=r"shipped model metaworld-mid; add --set pretrain\.model= "
    ):
        plan(*where, settings=[setting])
    assert plan(*where, settings=[setting, "pretrain.model="])
    assert plan(*where, settings=["size=mid"])  # as the preset's


def test_a_shipped_model_can_start_another_preset_with_the_settings_that_the_error_names(tmp_path):
    where = "metaworld", ["reach"], "debug", tmp_path, "wpt"
    model = "pretrain.model=metaworld-mid"
    with pytest.raises(ValueError, match=r"size=debug is not possible.*write --set size=mid as"):
        plan(*where, [model])
    assert plan(*where, [model, "size=mid"])
    assert plan("metaworld", ["reach"], "debug", tmp_path, "scratch", [model])


def test_a_shipped_model_that_does_not_exist_is_refused_before_any_work(tmp_path):
    with pytest.raises(ValueError, match=r"'metaworld-mit'. Did you mean 'metaworld-mid'"):
        plan("metaworld", ["reach"], "mid", tmp_path, "wpt", ["pretrain.model=metaworld-mit"])


def test_a_model_file_of_ones_own_can_start_a_run(tmp_path):
    where = "metaworld", ["reach"], "debug", tmp_path
    WPT(size="debug", max_action_dim=4).save(tmp_path / "own.zip")
    settings = [f"pretrain.model={tmp_path}/own.zip", "max_action_dim=4"]
    [run] = plan(*where, "wpt", settings)
    assert given_file(run.shared.given_model) == tmp_path / "own.zip"
    with pytest.raises(ValueError, match=r"the model .*own\.zip; add --set pretrain\.model= "):
        plan(*where, "wpt", [*settings, "pretrain.steps=5"])
    with pytest.raises(ValueError, match=r"other\.zip: there is no such file"):
        plan(*where, "wpt", [f"pretrain.model={tmp_path}/other.zip"])
    MRQ(channels=2, latent_dim=8, hidden_dim=8).save(tmp_path / "mrq.zip")
    with pytest.raises(ValueError, match=r"mrq\.zip is of MRQ"):
        plan(*where, "wpt", [f"pretrain.model={tmp_path}/mrq.zip"])


def test_a_setting_that_affects_one_of_the_methods_is_allowed(tmp_path):
    settings = ["sac.gamma=0.5", "plus.actor_delay=9"]
    request = Request("debug", "1", ["wpt", "wpt+", "sac"], settings, tmp_path)
    assert len(make_plan("dmc", ["walker-run"], request)) == 3


def test_settings_of_the_presets_data_are_refused_with_data_of_ones_own(tmp_path):
    with TrajectoryDataset.create(tmp_path / "own") as dataset:
        dataset.append(recorded(actions=6))
    where = "dmc", ["walker-run"], "debug", tmp_path
    with pytest.raises(ValueError, match="takes the place of the preset's data"):
        plan(*where, settings=["collect.episodes=5"], data=tmp_path / "own")
    assert plan(*where, settings=["collect.episodes=5"])


def test_data_too_wide_for_a_shipped_model_are_refused_with_a_remedy_that_works(tmp_path):
    with TrajectoryDataset.create(tmp_path / "own") as dataset:
        dataset.append(recorded(actions=7))
    where = "metaworld", ["reach"], "mid", tmp_path, "pretrain-only"
    with pytest.raises(ValueError, match=r"--set max_action_dim=7 pretrain\.model=$"):
        plan(*where, data=tmp_path / "own")
    settings = ["max_action_dim=7", "pretrain.model="]
    assert plan(*where, settings, data=tmp_path / "own")


def test_other_agents_are_pre_trained_by_as_many_updates_as_the_user_sets(tmp_path):
    [run] = plan("metaworld", ["drawer-close"], "mid", tmp_path, "r3m", ["pretrain.steps=5"])
    assert run.preset.pretrain.steps == 5
