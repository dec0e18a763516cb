"""A file as large as the published ones, 281 M parameters, with random weights."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from wpt_agents.files.official import WORLD_MODEL, parameter_names
from wpt_agents.model.sizes import SIZES
from wpt_agents.model.world_model import WorldModel

STATUS = Path("/proc/self/status")
# Peaks of resident memory: with everything imported, after loading, and after a step. The peak of
# `resource.getrusage` would not do: it is never below the memory of the process that forked.
LOAD = """
import json, re, sys
from pathlib import Path
import numpy as np
from wpt_agents.agents.wpt import WPT
def peak():
    return 1024 * int(re.search(r"VmHWM:\\s+(\\d+) kB", Path("/proc/self/status").read_text())[1])
WPT(size="debug", device="cpu").predict(np.zeros((64, 64, 3), np.uint8))
imported = peak()
model = WPT.from_official(sys.argv[1], device="cpu")
loaded = peak()
action, _ = model.predict(np.zeros((64, 64, 3), np.uint8))
parameters = sum(p.numel() for p in model.policy.world_model.dynamics_parameters())
print(json.dumps([imported, loaded, peak(), parameters, action.tolist(), model.size]))
"""


def write_file(path):
    """Writes a pre-trained world model of the paper's size, without its reward head."""
    size = replace(SIZES["paper"], gates="across", norm_eps=1e-5)
    with torch.device("meta"):
        shapes = {f"world_model.{k}": v.shape for k, v in WorldModel(size, 21).state_dict().items()}
    generator, content = torch.Generator().manual_seed(0), {"wm": {}}
    for part in WORLD_MODEL:
        content["wm"][part.removeprefix("wm.")] = {
            theirs: torch.empty(shapes[ours]).uniform_(-0.02, 0.02, generator=generator)
            for theirs, ours in parameter_names(part)
        }
    torch.save(content, path)


@pytest.mark.slow
@pytest.mark.skipif(not STATUS.exists(), reason="reads the peak of memory as Linux reports it")
def test_a_file_of_the_published_size_loads_in_little_more_memory_than_it_has(tmp_path):
    path = tmp_path / "dmcontrol.pt"
    write_file(path)
    done = subprocess.run(
        [sys.executable, "-c", LOAD, str(path)], check=True, capture_output=True, text=True
    )
    imported, loaded, acted, parameters, action, size = json.loads(done.stdout)
    bytes_of_file = path.stat().st_size
    times = [(peak - imported) / bytes_of_file for peak in (loaded, acted)]
    print(f"{bytes_of_file:,} bytes; loading took {times[0]:.2f} times that, a step {times[1]:.2f}")
    assert times[0] <= 1.3, times
    assert parameters == pytest.approx(281.4e6, rel=1e-3)
    assert (size["deter"], size["stoch"], size["classes"], size["units"]) == (12288, 32, 96, 512)
    assert len(action) == 21 and all(-1 <= entry <= 1 for entry in action)
