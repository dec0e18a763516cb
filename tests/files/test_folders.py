"""Files below a folder are found through links to folders, which may lead back."""

from wpt_agents.files.folders import files_below


def test_links_to_folders_are_followed_unless_they_lead_back(tmp_path):
    for name in ("in/a.npz", "in/b/c.npz", "in/b/d.txt", "elsewhere/e.npz"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "in" / "linked").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "elsewhere" / "back").symlink_to(tmp_path / "in")
    (tmp_path / "in" / "self").symlink_to(tmp_path / "in" / "self")
    names = [path.relative_to(tmp_path).as_posix() for path in files_below(tmp_path / "in")]
    assert names == ["in/a.npz", "in/b/c.npz", "in/b/d.txt", "in/linked/e.npz", "in/self"]
    assert len(list(files_below(tmp_path / "in", "*.npz"))) == 3
    assert not list(files_below(tmp_path / "nowhere"))
