"""What a run folder holds when its clearing was interrupted, or another process was faster."""

import pytest
from dot_runs import job

from wpt_agents.zoo.run import folder, runner
from wpt_agents.zoo.run.folder import check_folder, clear


def test_a_clearing_that_is_killed_at_any_point_can_be_done_again(tmp_path, monkeypatch):
    class Killed(BaseException):
        pass

    def killed(path):
        raise Killed

    one = job(tmp_path, "scratch")
    one.folder.mkdir(parents=True)
    for name in ("config.yaml", "model.zip", "result.json", "sequence.json", "lock"):
        (one.folder / name).touch()
    (one.folder / "task").mkdir()
    (one.folder / "task" / "scores.json").touch()
    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(folder.shutil, "rmtree", killed)
        clear(one.folder)
    left = {path.name for path in one.folder.rglob("*")}
    assert "config.yaml" in left
    assert not left & {"result.json", "sequence.json", "scores.json"}
    check_folder(one, force=True)
    clear(one.folder)
    assert [path.name for path in one.folder.iterdir()] == ["lock"]


def test_a_run_that_another_process_finishes_meanwhile_is_not_begun_again(tmp_path, monkeypatch):
    results = iter([None, "finished while this process waited for the lock"])
    monkeypatch.setattr(runner, "read_result", lambda folder: next(results))
    monkeypatch.setattr(runner, "do_stages", lambda job: "begun again")
    assert runner.run(job(tmp_path, "scratch")).startswith("finished while")


@pytest.mark.parametrize("content", ["", "wpt: [1", "- 1"])
def test_a_damaged_configuration_is_named(content, tmp_path):
    one = job(tmp_path, "scratch")
    one.folder.mkdir(parents=True)
    (one.folder / "config.yaml").write_text(content)
    with pytest.raises(ValueError, match=r"config\.yaml is not the configuration of a run"):
        check_folder(one, force=False)
    check_folder(one, force=True)
