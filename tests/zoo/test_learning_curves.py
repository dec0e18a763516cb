import numpy as np

from wpt_agents.zoo.learning_curves import Evaluations, TrainingEpisodes


def test_a_line_half_written_is_left_for_later(tmp_path):
    path = tmp_path / "0.monitor.csv"
    assert len(TrainingEpisodes.read(path)) == 0
    path.write_text("#")
    assert len(TrainingEpisodes.read(path)) == 0
    path.write_text('#{"t_start": 0}\nr,l,t\n3.0,25,10.0\n5.0,2')
    read = TrainingEpisodes.read(path)
    assert (read.lengths.tolist(), read.returns.tolist(), read.times.tolist()) == ([25], [3], [10])


def test_evaluations_have_successes_only_where_the_task_reports_them(tmp_path):
    path = tmp_path / "evaluations.npz"
    assert Evaluations.read(path) is None
    stored = {"timesteps": [10, 20], "results": [[1.0], [2.0]], "ep_lengths": [[5], [6]]}
    np.savez(path, **stored)
    read = Evaluations.read(path)
    assert read.steps.tolist() == [10, 20] and read.returns.tolist() == [[1.0], [2.0]]
    assert read.lengths.tolist() == [[5], [6]] and read.successes is None
    np.savez(path, **stored, successes=[[False], [True]])
    assert Evaluations.read(path).successes.tolist() == [[False], [True]]
