"""What a command needs on this machine."""

import pytest

from wpt_agents.zoo.machine import import_extra


def test_a_package_that_is_missing_is_named_with_the_command_that_installs_it():
    with pytest.raises(ValueError, match=r'no_such_package is not installed: .*wpt-agents\[ray\]"'):
        import_extra("no_such_package", "ray")


@pytest.mark.parametrize(
    ("code", "reason"),
    [
        ("raise ImportError('libfoo.so is missing')", "libfoo.so is missing"),
        ("from json import nothing", "cannot import name 'nothing'"),
    ],
)
def test_a_package_that_cannot_be_imported_is_not_called_missing(
    code, reason, tmp_path, monkeypatch
):
    (tmp_path / "spoilt_extra.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ValueError, match=rf"spoilt_extra cannot be imported \({reason}"):
        import_extra("spoilt_extra", "ray")


def test_an_extra_that_lacks_a_package_of_its_own_names_that_package(tmp_path, monkeypatch):
    (tmp_path / "lacking_extra.py").write_text("import no_such_package\n")
    monkeypatch.syspath_prepend(tmp_path)
    reason = "No module named 'no_such_package'"
    with pytest.raises(ValueError, match=rf"lacking_extra cannot be imported \({reason}\)"):
        import_extra("lacking_extra", "ray")
    with pytest.raises(ValueError, match=r"no_such_package.part is not installed"):
        import_extra("no_such_package.part", "peers")
