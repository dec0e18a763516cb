import platform
from importlib.metadata import PackageNotFoundError, version

from wpt_agents.zoo import provenance

CPUINFO = """processor\t: 0
cpu family\t: 25
model\t\t: 17
model name\t: AMD EPYC
flags\t\t: fpu avx512f

processor\t: 1
cpu family\t: 25
model\t\t: 17
model name\t: AMD EPYC
"""


def test_record_names_the_generation_of_the_processor(monkeypatch):
    monkeypatch.setattr(provenance, "cpu_model", lambda: CPUINFO)
    assert provenance.system()["cpu"] == "AMD EPYC, cpu family 25, model 17"


def test_record_names_the_processor_on_systems_without_cpuinfo(monkeypatch):
    monkeypatch.setattr(provenance, "cpu_model", lambda: "arm")
    monkeypatch.setattr(platform, "processor", lambda: "arm")
    assert provenance.cpu() == "arm"


def test_a_run_needs_no_simulator_that_is_not_installed(monkeypatch):
    def without_dm_control(name):  # it has no wheel for Python 3.13
        if name == "dm-control":
            raise PackageNotFoundError(name)
        return version(name)

    assert provenance.system()["versions"].keys() == set(provenance.PACKAGES)
    monkeypatch.setattr(provenance, "version", without_dm_control)
    assert provenance.system()["versions"].keys() == set(provenance.PACKAGES) - {"dm-control"}
