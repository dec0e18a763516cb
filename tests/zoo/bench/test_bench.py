import importlib
import json
import sys

import numpy as np
import pytest
import torch
from rich.console import Console, ConsoleDimensions
from torch import nn
from typer.testing import CliRunner

from wpt_agents.agents.wpt import WPT
from wpt_agents.fast import products
from wpt_agents.model.images import Decoder
from wpt_agents.model.layers import BlockLinear, UpConv
from wpt_agents.model.rssm import Latent
from wpt_agents.model.sizes import SIZES
from wpt_agents.model.world_model import reconstruction_error
from wpt_agents.zoo.bench import gpu, policy, profile, replay, scaling, timing, work
from wpt_agents.zoo.bench import model as bench_model
from wpt_agents.zoo.commands.app import app
from wpt_agents.zoo.commands.options import print_table

pytestmark = pytest.mark.slow  # it runs simulators or whole runs

KEYS = {
    *("what", "size", "params", "batch", "length", "threads", "dtype", "median_s", "gflop"),
    *("gflop_per_s", "ceiling_gflop_per_s", "share_of_ceiling", "rss_mb"),
}


def test_the_model_bench_prints_a_json_object_for_each_case():
    ran = CliRunner().invoke(app, ["bench", "model", "--quick", "--json"])
    assert ran.exit_code == 0, ran.output
    rows = [json.loads(line) for line in ran.stdout.splitlines()]
    assert [row["what"] for row in rows] == ["world model", "whole update"]
    for row in rows:
        assert set(row) >= KEYS
        assert row["gflop_per_s"] == pytest.approx(row["gflop"] / row["median_s"])
        assert torch.cuda.is_available() or row["onednn_gflop_per_s"] > 1
    alone, whole = rows
    assert whole["gflop"] > alone["gflop"] and whole["params"] > alone["params"]
    assert (alone["imagined"], whole["imagined"]) == (0, 2 * 8 * 16)  # from every state, 16 steps
    settings = ["imagine_starts=4", "imagine_horizon=3"]
    *_, few = bench_model.rows(quick=True, settings=settings)
    assert few["imagined"] == 4 * 3 and few["gflop"] < whole["gflop"]
    marked = bench_model.with_marks(bench_model.synthetic_batch(2, 8))
    assert marked.moving.shape == (2, 8, 64, 64) and 0.09 < marked.moving.float().mean() < 0.11
    assert next(bench_model.rows(quick=True, settings=["pixel_weight=8"]))["median_s"] > 0
    with pytest.raises(ValueError, match="batch_size"):  # which the case sets
        next(bench_model.rows(quick=True, settings=["batch_size=4"]))


def test_the_gpu_bench_measures_both_steps_and_needs_a_gpu():
    ran = CliRunner().invoke(app, ["bench", "gpu", "--quick", "--json"])
    assert ran.exit_code == 0, ran.output
    alone, whole = [json.loads(line) for line in ran.stdout.splitlines()]
    assert (alone["what"], whole["what"]) == ("pre-training", "whole update")
    assert whole["launches"] > alone["launches"] > 100 and whole["tflop"] > alone["tflop"] > 0
    assert alone["wall_s"] > 0 and 0 <= alone["launch_share"] <= 1
    if not torch.cuda.is_available():
        with pytest.raises(ValueError, match="torch finds none"):
            next(gpu.rows())


def test_several_threads_take_turns_with_one():
    seen = []
    torch.set_num_threads(2)
    try:
        step = (lambda: seen.append(torch.get_num_threads())), {}
        (row,) = bench_model.measured_in_turn([step], repetitions=2, counted=[lambda: None])
        assert torch.get_num_threads() == row["threads"] == 2 and row["times_one_thread"] > 0
    finally:
        torch.set_num_threads(1)
    assert seen == [2, *3 * [2, 1]]  # the memory; a warm-up and two repetitions
    (row,) = bench_model.measured_in_turn([step], repetitions=1, counted=[lambda: None])
    assert "times_one_thread" not in row


def test_a_product_by_convolution_counts_as_the_product(monkeypatch):
    monkeypatch.setattr(products, "AMD_AVX512", True)
    monkeypatch.setattr(products, "WORK", 0)
    layer, x = BlockLinear(32, 64, 4), torch.ones(products.MANY, 32)
    assert products.faster_by_convolution(x, 16)
    work = 2 * 2 * products.MANY * 32 * 64 / 4  # backward for the weights alone
    assert timing.gflop(lambda: layer(x).sum().backward()) == pytest.approx(work / 1e9)


def test_work_is_counted_as_the_layers_are_defined():
    # 3 x 5 by 5 x 7 is 2 * 105; backward the same twice, once without a gradient of the input
    layer, x = nn.Linear(5, 7), torch.ones(3, 5)
    assert timing.gflop(lambda: layer(x).sum().backward()) == pytest.approx(2 * 2 * 105 / 1e9)
    up, pixels = UpConv(4, 2, 6), torch.ones(3, 4, 5, 5)  # each of 5 x 5 pixels meets 6 x 6 weights
    work = 2 * 3 * 25 * 4 * 2 * 36
    assert timing.gflop(lambda: up(pixels)) == pytest.approx(work / 1e9)
    one, pixel = UpConv(4, 2, 5), torch.ones(3, 4, 1, 1)
    assert timing.gflop(lambda: one(pixel)) == pytest.approx(2 * 3 * 4 * 2 * 25 / 1e9)


def test_the_reconstruction_error_counts_as_the_decoder():
    decoder, image = Decoder(SIZES["debug"]), torch.zeros(2, 64, 64, 3, dtype=torch.uint8)
    state = Latent(torch.ones(2, 64), torch.ones(2, 8, 8))
    decoding = timing.gflop(lambda: decoder(*state))
    assert timing.gflop(lambda: reconstruction_error(decoder, state, image)) == decoding > 0


def test_the_median_leaves_the_warm_up_out():
    calls = []
    timing.seconds(lambda: calls.append(0), repetitions=3, warmup=2)
    assert len(calls) == 5


def test_one_thread_counts_processor_time_and_several_wall_clock(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    for threads, counted in ((1, "processor"), (2, "wall")):
        monkeypatch.setattr(torch, "get_num_threads", lambda threads=threads: threads)
        assert timing.cost("processor", "wall") == counted


def test_the_other_cases_yield_rows():
    acting = list(policy.rows(quick=True))
    assert [row["what"] for row in acting] == ["policy step", "policy step, by definition"]
    assert all(row["batch"] == 1 and row["median_s"] > 0 for row in acting)
    sampling, marked = replay.rows(quick=True)
    assert sampling["image_mb"] == pytest.approx(3 * 501 * 64 * 64 * 3 / 2**20)
    assert "background_s" not in sampling and marked["background_s"] > 0 and marked["median_s"] > 0
    every, *top = profile.rows(quick=True)
    assert every["count"] > sum(row["count"] for row in top) > 0
    shares = [row["share"] for row in top]
    assert shares == sorted(shares, reverse=True) and sum(shares) < 1


@pytest.mark.nightly  # half a minute
def test_scaling_tells_the_cost_of_a_unit_and_draws_it(tmp_path):
    picture = tmp_path / "new" / "growth.png"
    arguments = ["bench", "scaling", "--quick", "--json", "--plot", str(picture)]
    ran = CliRunner().invoke(app, arguments)
    assert ran.exit_code == 0, ran.output
    rows = [json.loads(line) for line in ran.stdout.splitlines()]
    assert [row["grows"] for row in rows] == ["environments", *4 * ["batch"]]
    for row in rows[1:]:
        assert row["unit"] == "image"
        images = row["batch"] * row["length"]
        assert row["ms_per_unit"] == pytest.approx(1000 * row["median_s"] / images)
    assert rows[0]["unit"] == "action"
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_each_axis_of_the_grid_holds_all_else_equal():
    for axis, cases in scaling.GRID.items():
        position = ("size", "batch", "length").index(axis)
        assert len({case[position] for case in cases}) == len(cases) > 2
        assert len({case[:position] + case[position + 1 :] for case in cases}) == 1


def test_the_memory_of_a_row_is_its_own():
    def peak(numbers):
        timing.forget_peak()
        before = timing.peak_rss_mb()
        torch.ones(numbers)
        return timing.peak_rss_mb() - before

    big, small = peak(64 * 2**18), peak(2**18)  # 64 and 1 MB of float32
    assert big > 60
    if sys.platform == "linux":  # elsewhere the system does not forget
        assert small < 20


@pytest.mark.nightly  # half a minute
def test_every_row_tells_the_memory():
    ran = CliRunner().invoke(app, ["bench", "profile", "--quick", "--json"])
    assert all(json.loads(line)["rss_mb"] > 0 for line in ran.stdout.splitlines())


def test_a_case_that_cannot_be_imported_says_what_it_needs(monkeypatch):
    import_module = importlib.import_module

    def missing(name, package=None):
        if "bench" in name:
            raise ModuleNotFoundError(f"No module named {name!r}", name="h5py")
        return import_module(name, package)

    monkeypatch.setattr("wpt_agents.zoo.commands.bench.importlib.import_module", missing)
    ran = CliRunner().invoke(app, ["bench", "data"])
    assert isinstance(ran.exception, ValueError)
    assert str(ran.exception).endswith(
        'h5py, which is not installed: pip install "wpt-agents[all]"'
    )
    ran = CliRunner().invoke(app, ["bench", "model", "--peer", "sheeprl"])
    assert str(ran.exception).endswith('pip install "wpt-agents[peers]"')
    ran = CliRunner().invoke(app, ["bench", "--quick"])
    assert ran.exit_code == 0 and "bench data is left out: it needs h5py" in ran.stderr


@pytest.mark.parametrize("words", [["data"], []])
@pytest.mark.parametrize(
    "fault",
    [
        ModuleNotFoundError("No module named 'wpt_agents.x'", name="wpt_agents.x"),
        ImportError("cannot import name 'x' from 'wpt_agents.y'", name="wpt_agents.y"),
    ],
)
def test_a_wrong_import_of_ours_is_not_called_a_missing_package(fault, words, monkeypatch):
    def broken(name, package=None):
        raise fault

    monkeypatch.setattr("wpt_agents.zoo.commands.bench.importlib.import_module", broken)
    assert CliRunner().invoke(app, ["bench", *words, "--quick"]).exception is fault


@pytest.mark.parametrize(
    ("case", "option"),
    [
        ("replay", ["--updates", "5"]),
        ("model", ["--behaviour", "icm"]),
        ("prediction", ["--steps", "9"]),
        ("work", ["--threads", "2"]),
        ("policy", ["--precision", "bf16"]),
        ("profile", ["--set", "gamma=0.9"]),
    ],
)
def test_an_option_without_effect_on_the_case_is_refused(case, option):
    ran = CliRunner().invoke(app, ["bench", case, "--quick", *option])
    assert f"{option[0]} has no effect on bench {case}" in str(ran.exception)


def test_a_table_shortens_nothing(monkeypatch, capsys):
    monkeypatch.setattr(Console, "size", ConsoleDimensions(60, 25))
    task = "metaworld-button-press-topdown-wall"
    print_table("envs", [{"what": "step", "task": task, "a_long_heading_of_a_column": 1}])
    printed = capsys.readouterr().out
    joined = "".join(c for c in printed if c.isalnum() or c in "-_")
    assert max(map(len, printed.splitlines())) <= 60 and "…" not in printed
    assert all(part in joined for part in ("button-press", "wall", "heading"))


def test_acting_by_definition_is_measured_by_the_definition():
    agent, seen = WPT(size="debug", max_action_dim=2, seed=0), []

    def act():
        state, image = agent.policy.initial_state(1), np.zeros((1, 64, 64, 3), np.uint8)
        seen.append(work.launches(lambda: agent.policy.act(image, state, None)))

    act()  # which makes what is kept for the next steps
    act()
    policy.by_definition(act)
    act()
    assert seen[1] == seen[3] < seen[2]


def test_calls_are_of_operators_that_compute():
    x = torch.ones(2, 3, requires_grad=True)
    assert work.launches(lambda: x.t()[0].unsqueeze(0)) == 0
    assert work.launches(lambda: (x * 2) + 1) == 2
    assert work.launches(lambda: (x * 2).sum().backward()) > 3


def test_the_work_of_a_batch_is_counted_on_a_part_of_it():
    rows = list(work.rows(quick=True))
    assert [row["what"] for row in rows] == ["world model", "whole update"]
    model = bench_model.agent("debug")
    step = bench_model.world_model_step(model, bench_model.synthetic_batch(2, 8))
    assert rows[0]["tflop"] == pytest.approx(timing.gflop(step) * 64 / 1e3, rel=0.02)
    assert rows[1]["operator_calls"] > rows[0]["operator_calls"] > 100
