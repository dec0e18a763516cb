import numpy as np
import pytest
from chain import chain, check_chain, tensors

from wpt_agents.data.replay import ReplayBuffer, mix
from wpt_agents.data.windows import Windows


def filled(*trajectories):
    replay = ReplayBuffer()
    for trajectory in trajectories:
        replay.add(trajectory)
    return replay


def rng(seed=0):
    return np.random.default_rng(seed)


def test_a_sample_keeps_to_the_chain():
    replay = filled(*(chain(20, seed, terminated=seed % 2 == 0) for seed in range(5)))
    batch = replay.sample(32, 8, action_width=4, rng=rng())
    check_chain(batch)
    assert batch.image.shape == (32, 8, 8, 8, 3)
    assert batch.action.shape == (32, 8, 4)
    assert not batch.action[..., 2:].any()


def test_every_window_is_equally_likely():
    windows = Windows(np.array([9, 6, 4]))
    # Images 10, 7, 5 and windows of 4: 7 + 4 + 2 = 13 of them
    seen = {(i, s): 0 for i, n in enumerate((7, 4, 2)) for s in range(n)}
    for row in windows.draw(13_000, 4, rng()):
        [(i, start, stop)] = row
        assert stop - start == 4
        seen[i, start] += 1
    # Chi-square with 12 degrees of freedom exceeds 32.9 once in a thousand
    assert sum((n - 1000) ** 2 / 1000 for n in seen.values()) < 32.9


def test_a_trajectory_of_just_the_length_is_one_window():
    assert Windows(np.array([3])).draw(2, 4, rng()) == [[(0, 0, 4)]] * 2


def test_short_trajectories_are_chained_whole_with_is_first_at_each_joint():
    batch = filled(chain(2, 1, terminated=True), chain(4, 2)).sample(64, 16, 2, rng())
    check_chain(batch)
    first, terminal = batch.is_first.numpy(), batch.is_terminal.numpy()
    # Images 3 and 5: the next joint is 3 or 5 further, and 3 exactly after a terminal image
    for row in range(64):
        joints = np.flatnonzero(first[row])
        assert set(np.diff(joints)) <= {3, 5}
        assert all(t + 1 in joints for t in np.flatnonzero(terminal[row]) if t < 15)
    assert terminal.any()


def test_short_trajectories_are_drawn_as_one_window_each():
    rows = Windows(np.array([1, 2, 10])).draw(10_000, 8, rng())
    starts = np.bincount([row[0][0] for row in rows])
    # 11 images have 4 windows of 8; the two short ones count as one each
    np.testing.assert_allclose(starts / 10_000, [1 / 6, 1 / 6, 4 / 6], atol=0.02)


def test_the_same_rng_draws_the_same_batch():
    replay = filled(chain(20), chain(3, 1))
    one, two = (tensors(replay.sample(8, 6, 2, rng(5))) for _ in range(2))
    for name in one:
        np.testing.assert_array_equal(one[name], two[name])


def test_len_counts_transitions():
    assert len(filled(chain(20), chain(3))) == 23


def test_an_empty_buffer_is_not_sampled():
    with pytest.raises(ValueError, match="empty; add a trajectory"):
        ReplayBuffer().sample(1, 2, 1, rng())


def test_more_actions_than_the_agent_has_are_refused():
    replay = filled(chain(5, action_dim=3, embodiment="crab"))
    with pytest.raises(ValueError, match="crab has 3 actions, the agent takes 2"):
        replay.sample(1, 4, 2, rng())


def test_another_image_size_is_refused():
    with pytest.raises(ValueError, match=r"\(8, 8, 3\), got \(16, 16, 3\)"):
        filled(chain(5), chain(5, size=16))


def test_mix_puts_online_first_and_hides_the_rewards_of_retrieved():
    online, retrieved = filled(chain(20, embodiment="a")), filled(chain(20, 1, action_dim=1))
    batch = mix(online, retrieved, 0.25, 16, 8, 2, rng())
    check_chain(batch)
    assert batch.reward_known[:12, 1:].all()
    assert not batch.reward_known[12:].any()
    assert not batch.reward[12:].any()
    assert batch.action[:12, 1:, 1].any()
    assert not batch.action[12:, :, 1].any()  # retrieved has one action entry


@pytest.mark.parametrize(("ratio", "others"), [(0.0, 0), (0.25, 2), (0.5, 4), (1.0, 8)])
def test_mix_takes_the_share_asked_for(ratio, others):
    batch = mix(filled(chain(9)), filled(chain(9, 1)), ratio, 8, 4, 2, rng())
    assert (~batch.reward_known[:, 1:].all(1)).sum() == others


def test_a_share_of_the_online_rows_comes_from_the_five_newest_episodes():
    online, retrieved = filled(*(chain(20, seed) for seed in range(12))), filled(chain(20, 12))
    rows = online.draw_recent(40, 8, rng())
    assert {i for row in rows for i, _, _ in row} == {7, 8, 9, 10, 11}
    one, all_recent = (mix(online, retrieved, 0.25, 16, 8, 2, rng(), s) for s in (0.25, 1.0))
    for batch in (one, all_recent):
        check_chain(batch)
        assert batch.reward_known[:12, 1:].all() and not batch.reward_known[12:].any()
    plain, none = (mix(online, retrieved, 0.25, 16, 8, 2, rng(), *more) for more in ((), (0.0,)))
    assert all((array == tensors(none)[name]).all() for name, array in tensors(plain).items())


def test_fewer_episodes_than_five_are_all_the_newest():
    rows = filled(chain(20), chain(20, 1)).draw_recent(40, 8, rng())
    assert {i for row in rows for i, _, _ in row} == {0, 1}


@pytest.mark.parametrize("retrieved", [None, ReplayBuffer()])
def test_mix_without_retrieved_data_is_all_online(retrieved):
    batch = mix(filled(chain(9)), retrieved, 0.5, 8, 4, 2, rng())
    assert batch.reward_known[:, 1:].all()


def test_mix_refuses_a_share_above_one():
    with pytest.raises(ValueError, match=r"in \[0, 1\], got 25"):
        mix(filled(chain(9)), filled(chain(9)), 25, 8, 4, 2, rng())


def test_a_saved_buffer_comes_back_whole(tmp_path):
    replay = filled(
        chain(5, terminated=True, embodiment="walker", task="run", bounds=[[0, -2], [1, 2]]),
        chain(3, reward=None, action_dim=4, source="ours"),
    )
    replay.save(tmp_path / "some where.any")
    back = ReplayBuffer.load(tmp_path / "some where.any")
    assert len(back) == len(replay)
    for old, new in zip(replay.trajectories, back.trajectories, strict=True):
        for name, value in vars(old).items():
            np.testing.assert_array_equal(getattr(new, name), value)
    assert [p.name for p in tmp_path.iterdir()] == ["some where.any"]


def test_an_empty_buffer_is_saved_too(tmp_path):
    ReplayBuffer().save(tmp_path / "replay")
    assert len(ReplayBuffer.load(tmp_path / "replay")) == 0


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9, 0.999])
def test_a_truncated_file_is_refused_by_name(tmp_path, share):
    filled(chain(50)).save(tmp_path / "replay")
    content = (tmp_path / "replay").read_bytes()
    (tmp_path / "replay").write_bytes(content[: int(share * len(content))])
    with pytest.raises(ValueError, match="replay is damaged or not a ReplayBuffer"):
        ReplayBuffer.load(tmp_path / "replay")


def test_a_flipped_bit_is_noticed(tmp_path):
    filled(chain(50)).save(tmp_path / "replay")
    content = bytearray((tmp_path / "replay").read_bytes())
    content[len(content) // 2] ^= 1
    (tmp_path / "replay").write_bytes(content)
    with pytest.raises(ValueError, match="Bad CRC-32"):
        ReplayBuffer.load(tmp_path / "replay")


def test_a_pickle_is_refused_and_not_run(tmp_path):
    np.save(tmp_path / "replay.npy", np.array([object()]), allow_pickle=True)
    with pytest.raises(ValueError, match="not a ReplayBuffer"):
        ReplayBuffer.load(tmp_path / "replay.npy")


def test_a_failed_save_leaves_the_old_file(tmp_path, monkeypatch):
    filled(chain(5)).save(tmp_path / "replay")

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("numpy.lib.format.write_array", full)
    with pytest.raises(OSError, match="No space"):
        filled(chain(9)).save(tmp_path / "replay")
    assert len(ReplayBuffer.load(tmp_path / "replay")) == 5
    assert [p.name for p in tmp_path.iterdir()] == ["replay"]
