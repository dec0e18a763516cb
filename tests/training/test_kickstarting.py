import pytest

from wpt_agents.training.hyperparameters import Hyperparameters
from wpt_agents.training.kickstarting import Adaptive, parse_kickstart


def test_the_weight_falls_by_a_fifth_with_each_episode_as_good_as_the_prior_actors():
    weight = Adaptive(20, 1).weight
    prior = [80.0, 100.0]  # 90 is enough
    assert weight(prior, []) == 20
    assert weight(prior, [90.0]) == pytest.approx(16)
    assert weight(prior, [90.0, 95.0]) == pytest.approx(12.8)
    assert weight(prior, [90.0] * 13) == pytest.approx(20 * 0.8**13)
    assert weight(prior, [90.0] * 14) == 1  # 20 * 0.8^14 = 0.88


def test_the_weight_rises_again_when_the_mean_of_the_five_newest_is_too_low():
    weight = Adaptive(20, 1).weight
    prior = [90.0]
    assert weight(prior, [89.0]) == 20  # it is never above its start
    good = [100.0] * 5
    # (4 * 100 + 51) / 5 = 90.2 is enough, (4 * 100 + 49) / 5 = 89.8 is not
    assert weight(prior, [*good, 51.0]) == pytest.approx(20 * 0.8**6)
    assert weight(prior, [*good, 49.0]) == pytest.approx(20 * 0.8**4)
    # 49 is among the five newest in five windows, all of which are too low, and not in the sixth
    assert weight(prior, [*good, 49.0, *good[:4]]) == pytest.approx(20)
    assert weight(prior, [*good, 49.0, *good]) == pytest.approx(16)


def test_returns_may_be_negative():
    weight = Adaptive(8, 0).weight
    assert weight([-100.0], [-99.0]) == pytest.approx(6.4)
    assert weight([-100.0], [-101.0]) == 8
    assert weight([0.0], [0.0]) == pytest.approx(6.4)


def test_without_an_episode_of_the_prior_actor_the_weight_stays():
    assert Adaptive(20, 1).weight([], [5.0, 6.0]) == 20


@pytest.mark.parametrize(
    "text", ["adaptive(1,20)", "adaptive(20)", "adaptive(20,-1)", "adaptive(inf,1)", "adaptive", -1]
)
def test_other_weights_are_refused_with_an_example(text):
    with pytest.raises(ValueError, match=r"kickstart=.*not understood.*'adaptive\(20,1\)'"):
        parse_kickstart(text)
    with pytest.raises(ValueError, match=r"kickstart=.*not understood"):
        Hyperparameters(kickstart=text)


def test_the_keyword_knows_the_returns():
    settings = Hyperparameters(kickstart="adaptive(20, 1)")
    assert settings.imitates and settings.needs_clone
    assert settings.kickstart_at(5) == 20
    assert settings.kickstart_at(5, [1.0], [1.0]) == pytest.approx(16)
    assert Hyperparameters(kickstart="linear(20,0,10)").kickstart_at(5, [1.0], [1.0]) == 10
