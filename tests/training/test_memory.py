"""Memory stays flat while a dataset that is larger than it is pre-trained on, and while loading."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.data.trajectory import Trajectory

ROOT = Path(__file__).parents[2]
STATUS = Path("/proc/self/status")
MEGABYTES = 600  # of images on disk, several times what the process may grow by
PROGRAM = """
import json, re, sys
from pathlib import Path
from wpt_agents import WPT
def resident():
    return int(re.search(r"VmRSS:\\s+(\\d+) kB", Path("/proc/self/status").read_text())[1]) / 1024
seen = []
model = WPT.pretrain(
    sys.argv[1], steps=500, size="debug", batch_size=4, batch_length=16, max_action_dim=2, seed=0,
    device="cpu", callback=lambda step, _: seen.append(resident()) if step % 50 == 0 else None,
)
model.save(sys.argv[2])
loads = []
for _ in range(6):
    model = WPT.load(sys.argv[2], device="cpu")
    loads.append(resident())
print(json.dumps([seen, loads]))
"""


@pytest.mark.nightly
@pytest.mark.skipif(not STATUS.exists(), reason="reads the memory as Linux reports it")
def test_pretraining_on_a_large_dataset_and_loading_again_and_again_take_no_more_memory(tmp_path):
    rng = np.random.default_rng(0)
    with TrajectoryDataset.create(tmp_path / "data", codec="raw") as dataset:
        for _ in range(MEGABYTES * 2**20 // (501 * 64 * 64 * 3)):
            image = rng.integers(0, 256, (501, 64, 64, 3), np.uint8)
            dataset.append(Trajectory(image, rng.uniform(-1, 1, (500, 2)).astype(np.float32)))
    words = [sys.executable, "-c", PROGRAM, str(tmp_path / "data"), str(tmp_path / "model.zip")]
    process = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    assert process.returncode == 0, process.stderr
    seen, loads = json.loads(process.stdout.splitlines()[-1])
    print(seen, loads)
    assert max(seen[2:]) < 1.05 * seen[1], seen  # of which the dataset would be a multiple
    assert max(loads[2:]) < 1.02 * loads[1], loads
