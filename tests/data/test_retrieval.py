import numpy as np
import pytest
from chain import chain

from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.data.replay import ReplayBuffer
from wpt_agents.data.retrieval import Retriever


def retriever(features, action_dims=None, embodiments=None):
    n = len(features)
    features = np.asarray(features, np.float32)
    return Retriever(features, np.asarray(action_dims or [2] * n), embodiments or [None] * n, "e1")


def test_eq_5_by_hand():
    #     e(o_off)          D to (0, 0)
    #  0  (3, 4)            sqrt(9 + 16) = 5
    #  1  (1, 0)            1
    #  2  (0, -2)           2
    indices, distances = retriever([[3, 4], [1, 0], [0, -2]]).search(np.zeros(2), k=3)
    assert indices.tolist() == [1, 2, 0]
    assert distances.tolist() == [1, 2, 5]


def test_the_search_equals_brute_force_across_chunks(monkeypatch):
    monkeypatch.setattr("wpt_agents.data.retrieval.CHUNK", 64)
    rng = np.random.default_rng(0)
    features, query = rng.normal(size=(500, 7)), rng.normal(size=7)
    indices, distances = retriever(features).search(query, k=100)
    distance = np.sqrt(((features - query) ** 2).sum(1))
    np.testing.assert_array_equal(indices, np.argsort(distance)[:100])
    np.testing.assert_allclose(distances, np.sort(distance)[:100], rtol=1e-4)


def test_several_queries_take_their_nearest_in_turns_and_none_twice():
    #  e(o_off)   D to 0   D to 10
    #  0   0.5      0.5      9.5
    #  1   2        2        8
    #  2   1        1        9
    #  3   10.2    10.2      0.2
    #  4   5        5        5
    # in turns: 3 (0.2), 0 (0.5); 2 (1), 4 (5); 1 (2), for 1 is the third of both
    features = [[0.5], [2], [1], [10.2], [5]]
    indices, distances = retriever(features).search(np.array([[0.0], [10.0]]), k=5)
    assert indices.tolist() == [3, 0, 2, 4, 1]
    np.testing.assert_allclose(distances, [0.2, 0.5, 1, 5, 2], rtol=1e-6)
    assert retriever(features).search(np.array([[0.0], [10.0]]), k=3)[0].tolist() == [3, 0, 2]
    one, two = (retriever(features).search(np.zeros(shape), k=3)[0] for shape in ((1,), (1, 1)))
    assert one.tolist() == two.tolist() == [0, 2, 1]


def test_the_share_of_the_nearest_that_are_of_ones_own_robot():
    # at 0, 1, 2 a walker; at 10, 11 an arm: of two others each, walkers find 2 of 2, arms 1 of 2
    places = np.array([[0.0], [1.0], [2.0], [10.0], [11.0]])
    names = ["walker"] * 3 + ["arm"] * 2
    one = Retriever(places, np.ones(5, int), names, "encoder")
    assert one.own_share(k=2) == pytest.approx((3 * 2 + 2 * 1) / 10)
    assert one.own_share(k=1) == 1
    assert (
        Retriever(places, np.ones(5, int), ["walker", None] * 2 + [None], "e").own_share() is None
    )
    # those without a name, wherever they are, neither ask nor answer
    more, labels = np.concatenate([[[0.1]], places, [[10.1]]]), [None, *names, None]
    assert Retriever(more, np.ones(7, int), labels, "e").own_share(k=2) == one.own_share(k=2)


def test_fewer_candidates_than_asked_for_are_all_returned_once():
    indices, distances = retriever([[2.0], [1.0]]).search(np.zeros(1), k=500)
    assert indices.tolist() == [1, 0]
    assert distances.tolist() == [1, 2]


def test_equal_first_observations_are_each_returned_once_in_order():
    indices, _ = retriever([[1.0]] * 5 + [[0.5]]).search(np.zeros(1), k=4)
    assert indices.tolist() == [5, 0, 1, 2]


def test_only_the_action_width_asked_for():
    indices, _ = retriever([[0], [1], [2]], action_dims=[6, 2, 6]).search(np.zeros(1), 3, None, 6)
    assert indices.tolist() == [0, 2]


def test_a_label_excludes_others_and_keeps_the_unlabelled():
    index = retriever([[0], [1], [2]], embodiments=["cheetah", "walker", None])
    assert index.search(np.zeros(1), 3, "walker")[0].tolist() == [1, 2]
    assert index.search(np.zeros(1), 3, "crab", action_dim=2)[0].tolist() == [2]


def test_drawing_blindly_keeps_to_the_candidates_and_takes_each_once():
    index = retriever([[0]] * 6, action_dims=[6, 2, 6, 6, 6, 6])
    drawn = [index.draw(3, np.random.default_rng(seed), None, 6).tolist() for seed in range(40)]
    assert all(len(set(numbers)) == 3 for numbers in drawn) and {i for d in drawn for i in d} == {
        0,
        *range(2, 6),
    }
    assert sorted(index.draw(9, np.random.default_rng(0), None, 6)) == [0, 2, 3, 4, 5]


def test_no_candidate_is_an_empty_answer():
    indices, distances = retriever([[0.0]]).search(np.zeros(1), 3, action_dim=9)
    assert len(indices) == len(distances) == 0


def test_the_index_is_built_of_first_observations(tmp_path):
    with TrajectoryDataset.create(tmp_path, image_size=8) as dataset:
        for seed in range(5):
            dataset.append(chain(20, seed, embodiment="walker"))
    built = Retriever.build(dataset, lambda image: image[:, 0, 0].astype(np.float32), "e1")
    first = [trajectory.image[0, 0, 0].tolist() for trajectory in dataset]
    assert built.features.tolist() == first
    assert built.search(np.array(first[3]), 1)[0] == [3]
    assert (len(built), built.embodiments) == (5, ["walker"] * 5)


def test_features_that_are_not_finite_are_refused():
    with pytest.raises(ValueError, match="NaN"):
        retriever([[np.nan]])


def test_a_query_of_another_encoder_width_is_refused():
    with pytest.raises(ValueError, match=r"shape \(3,\).*\(1,\)"):
        retriever([[0.0]]).search(np.zeros(3), 1)


def test_a_saved_index_answers_the_same(tmp_path):
    old = retriever([[3, 4], [1, 0], [0, -2]], [2, 2, 6], ["a", None, "b"])
    old.save(tmp_path / "index")
    new = Retriever.load(tmp_path / "index", "e1")
    for query in ({"embodiment": "a"}, {"action_dim": 6}, {}):
        for one, two in zip(
            old.search(np.ones(2), 3, **query), new.search(np.ones(2), 3, **query), strict=True
        ):
            np.testing.assert_array_equal(one, two)


def test_the_index_of_another_encoder_is_refused_with_the_remedy(tmp_path):
    retriever([[0.0]]).save(tmp_path / "index")
    with pytest.raises(ValueError, match="encoder e1, not with e2; it needs to be built again"):
        Retriever.load(tmp_path / "index", "e2")


def test_a_damaged_index_beside_a_dataset_is_built_again(tmp_path):
    with TrajectoryDataset.create(tmp_path / "data", image_size=8) as dataset:
        for seed in range(3):
            dataset.append(chain(5, seed))

    def embed(image):
        return image.reshape(len(image), -1)[:, :4].astype(np.float32)

    whole = Retriever.beside(dataset, embed, "abc")
    path = tmp_path / "data" / "retrieval-abc.index"
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.warns(UserWarning, match=r"built again: .*retrieval-abc\.index is damaged"):
        again = Retriever.beside(dataset, embed, "abc")
    np.testing.assert_array_equal(again.features, whole.features)
    np.testing.assert_array_equal(Retriever.load(path, "abc").features, whole.features)


def test_another_kind_of_file_is_refused(tmp_path):
    ReplayBuffer().save(tmp_path / "index")
    with pytest.raises(ValueError, match="it holds a ReplayBuffer"):
        Retriever.load(tmp_path / "index", "e1")


def test_an_empty_dataset_makes_an_index_that_finds_nothing(tmp_path):
    dataset = TrajectoryDataset.create(tmp_path)
    built = Retriever.build(dataset, lambda image: image, "e1")
    assert len(built.search(np.zeros(0), 5)[0]) == 0
